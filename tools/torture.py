"""Torture the command line: mutated inputs, kills, full disks, two processes in one folder.

    python tools/torture.py --minutes 5                    # all parts, for about that long
    python tools/torture.py --trials 200 --only scene field
    python tools/torture.py --replay scene:17 optimiser:4

Every trial is determined by its kind and its seed. A trial of a mutated input passes if the verb
ends with status 0, or with status 2 and one sentence at the end of standard error; without a
traceback, within 10 s of the time and 1.5 times the memory of the valid input; without a file
outside its output folder; and, after status 0, without NaN in what it wrote. Verbs run in forked
processes with a small field. The result is JSON on standard output, and the exit status is 1 if a
trial failed.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.torture_parts import inputs, stops  # noqa: E402
from tools.torture_parts.trials import KINDS, Campaign, Trial, run_trial, summary  # noqa: E402
from tools.torture_parts.zygote import Runner  # noqa: E402

STOPPED = ("fit", "render", "capture")
TOGETHER = ("render", "fit")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=4.0, help="time in all, about")
    parser.add_argument("--trials", type=int, default=10**6, help="greatest number of mutations")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first trial")
    parser.add_argument("--only", nargs="*", default=(), help="kinds, such as scene stop-fit")
    parser.add_argument("--replay", nargs="*", default=(), metavar="KIND:SEED")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="torture-") as folder:
        found = campaign(
            Path(folder),
            seconds=60 * options.minutes,
            trials=options.trials,
            first_seed=options.first_seed,
            only=options.only,
            replay=options.replay,
        )
    json.dump(found, sys.stdout, indent=1)
    sys.stdout.write("\n")
    return int(bool(found["failures"]))


def campaign(
    folder: Path,
    seconds: float = 240.0,
    trials: int = 10**6,
    first_seed: int = 0,
    only: Sequence[str] = (),
    replay: Sequence[str] = (),
) -> dict:
    """Run trials in an empty folder, and return counts and failures.

    Args:
        folder: receives inputs and outputs; real, not behind a link.
        seconds: no trial begins after this time. Two thirds of it are for mutated inputs.
        trials: greatest number of mutated inputs.
        first_seed: seed of the first trial of each kind.
        only: kinds to try; none: all.
        replay: single trials, as "KIND:SEED".
    """
    begun = time.monotonic()
    folder = folder.resolve()
    done: list[Trial] = []
    skipped: dict[str, str] = {}
    (folder / "a").mkdir()
    with Runner(folder / "a") as runner:
        state = Campaign(folder / "originals", folder / "a", runner)
        state.originals.mkdir()
        inputs.build(state.originals, runner)
        if replay:
            pairs = [name.rpartition(":")[::2] for name in replay]
            for kind, seed in pairs:
                done += _kept(_one(state, kind, int(seed), folder), kind, skipped)
            return summary(done) | {"skipped": skipped}
        chosen = [kind for kind in KINDS if not only or kind in only]
        others = [kind for kind in _disturbances() if not only or kind in only]
        until = begun + seconds * (2 / 3 if others else 1)
        seed = first_seed
        while chosen and len(done) < trials and time.monotonic() < until:
            for kind in chosen:
                if len(done) < trials and time.monotonic() < until:
                    done.append(_noted(run_trial(state, kind, seed)))
            seed += 1
        seed = first_seed
        while others and time.monotonic() < begun + seconds:
            for kind in list(others):
                if time.monotonic() < begun + seconds:
                    done += _kept(_one(state, kind, seed, folder), kind, skipped)
                    if kind in skipped:
                        others.remove(kind)
            seed += 1
    found = summary(done)
    return found | {"skipped": skipped, "seconds": round(time.monotonic() - begun, 1)}


def _disturbances() -> dict[str, Callable[[Campaign, int, Path], Trial | str]]:
    """Return the functions that run trials other than mutations, by kind."""
    found: dict[str, Callable[[Campaign, int, Path], Trial | str]] = {}
    for verb in STOPPED:
        found[f"stop-{verb}"] = lambda state, seed, _, verb=verb: stops.stopped(state, verb, seed)
    for verb in stops.DISKS:
        found[f"disk-{verb}"] = lambda state, seed, _, verb=verb: stops.on_full_disk(
            state, verb, seed
        )
    for verb in TOGETHER:
        found[f"two-{verb}"] = lambda state, seed, folder, verb=verb: _twice(
            state, verb, seed, folder
        )
    return found


def _twice(state: Campaign, verb: str, seed: int, folder: Path) -> Trial:
    (folder / "b").mkdir(exist_ok=True)
    with Runner(folder / "b") as other:
        return stops.two_at_once(state, verb, seed, other)


def _one(state: Campaign, kind: str, seed: int, folder: Path) -> Trial | str:
    if kind in KINDS:
        return run_trial(state, kind, seed)
    if kind == "stop-capture" and "capture" not in stops.commands(state, folder):
        return "capture needs pycolmap"
    return _disturbances()[kind](state, seed, folder)


def _kept(result: Trial | str, kind: str, skipped: dict[str, str]) -> list[Trial]:
    if isinstance(result, str):
        skipped[kind] = result
        return []
    return [_noted(result)]


def _noted(trial: Trial) -> Trial:
    """Print the result on standard error at once, in case the campaign is stopped."""
    verdict = "; ".join(trial.faults) or "passes"
    line = f"{trial.name} [{trial.mutation}] status {trial.status}: {verdict}"
    print(ascii(line), file=sys.stderr, flush=True)
    return trial


if __name__ == "__main__":
    sys.exit(main())
