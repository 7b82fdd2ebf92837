"""Hash a fixed fit and fixed frames, to prove that a refactoring changes no number.

    python tools/golden.py before.json            # fit and render, about four minutes on one core
    python tools/golden.py after.json
    python tools/golden.py --compare before.json after.json

The fit is 300 steps on the embedded street at half size with seed 0, on one thread. The frames show
one training view clean, flooded, in smog, under snow and in all weathers at once, each with all
layers. The script calls the command line alone, so that it survives every move of the code. With
--run FOLDER an existing run is rendered and nothing is fitted.

Kernels that Numba has just compiled and kernels that it loads from its cache differ in roundings,
which a fit amplifies. Therefore every comparison begins with an empty cache of its own.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from safetensors.numpy import load_file

STREET = Path(__file__).resolve().parents[1] / "src" / "climatenerf" / "assets" / "street"
STEPS = 300
SIZE = "192x108"
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
FLOOD = ["--flood.level", "0.4 m", "--flood.wind-speed", "3 m/s"]
SMOG = ["--smog.visibility", "60 m", "--smog.height-falloff", "20 m"]
SNOW = ["--snow.depth", "12 cm", "--sun.elevation", "35 deg", "--sun.azimuth", "140 deg"]
WEATHERS = {
    "clean": [],
    "flood": FLOOD,
    "mirror": ["--flood.level", "0.3 m", "--flood.wind-speed", "0 m/s"],
    "smog": SMOG,
    "snow": SNOW,
    "all": FLOOD + SMOG + SNOW,
}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path, nargs="?", help="JSON file for the hashes")
    parser.add_argument("--run", type=Path, help="render this run; fit nothing")
    parser.add_argument("--keep", type=Path, help="keep run and frames in this folder")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("BEFORE", "AFTER"))
    options = parser.parse_args()
    if options.compare:
        sys.exit(compare(*(json.loads(path.read_text()) for path in options.compare)))
    if options.out is None:
        parser.error("give the JSON file to write, or --compare BEFORE AFTER")
    with tempfile.TemporaryDirectory() as temporary:
        os.environ["NUMBA_CACHE_DIR"] = str(Path(temporary) / "numba")
        hashes = golden(options.keep or Path(temporary), options.run)
    options.out.write_text(json.dumps(hashes, indent=1) + "\n")


def golden(folder: Path, run: Path | None) -> dict[str, str]:
    """Hashes of the field's tensors and of every frame and layer, by name."""
    hashes = {}
    if run is None:
        run = folder / "run"
        limits = ["--steps", str(STEPS), "--downscale", "2", "--seed", "0"]
        climatenerf("fit", str(STREET), "-o", str(run), *limits)
        tensors = load_file(run / "field.safetensors")
        hashes |= {f"field/{name}": hash_of(values) for name, values in tensors.items()}
    for name, flags in WEATHERS.items():
        out = folder / name
        still = ["--path", "still:0020", "--frames", "1", "--size", SIZE, "--layers", "all"]
        climatenerf("render", str(run), "-o", str(out), *still, *flags)
        with Image.open(out / "frames" / "0000.png") as picture:
            hashes[f"{name}/frame"] = hash_of(np.asarray(picture))
        for path in sorted(out.glob("*/0000.npz")):
            with np.load(path) as arrays:
                hashes[f"{name}/{path.parent.name}"] = hash_of(arrays[path.parent.name])
    return hashes


def climatenerf(*args: str) -> None:
    """Run a verb of the command line on one thread."""
    command = [sys.executable, "-m", "climatenerf", *args]
    subprocess.run(command, env=os.environ | ONE_THREAD, check=True, stdout=subprocess.DEVNULL)


def hash_of(values: np.ndarray) -> str:
    """Hash of an array's type, shape and bytes."""
    about = f"{values.dtype} {values.shape}".encode()
    return hashlib.sha256(about + np.ascontiguousarray(values).tobytes()).hexdigest()[:16]


def compare(before: dict[str, str], after: dict[str, str]) -> int:
    """Print each name whose hash differs; return the exit status."""
    names = sorted(before.keys() | after.keys())
    changed = [name for name in names if before.get(name) != after.get(name)]
    for name in changed:
        print(f"{name}: {before.get(name, 'absent')} before, {after.get(name, 'absent')} after")
    print(f"{len(names) - len(changed)} of {len(names)} equal")
    return 1 if changed else 0


if __name__ == "__main__":
    main()
