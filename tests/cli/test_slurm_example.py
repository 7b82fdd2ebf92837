"""The example for SLURM, with a stand-in for `sbatch` that runs what it is given at once."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "slurm" / "render.sh"

SBATCH = """#!/bin/bash
set -euo pipefail
last=1 command="" log=/dev/null
for word in "$@"; do
    case $word in
        --array=1-*) last=${word#--array=1-} ;;
        --wrap=*) command=${word#--wrap=} ;;
        --output=*) log=${word#--output=} ;;
        --dependency=*) echo "$word" >> "$JOBS" ;;
    esac
done
for ((task = last; task >= 1; task--)); do
    SLURM_ARRAY_TASK_ID=$task bash -c "$command" > "${log//%a/$task}" 2>&1
    echo "$command" >> "$JOBS"
done
echo "4711;cluster"
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs bash")
def test_parts_are_rendered_and_joined(run_folder, tmp_path):
    programs, out = tmp_path / "bin", tmp_path / "movie of a flood"
    programs.mkdir()
    (programs / "sbatch").write_text(SBATCH)
    program = f'#!/bin/sh\nexec "{sys.executable}" -m climatenerf "$@"\n'
    (programs / "climatenerf").write_text(program)
    for path in programs.iterdir():
        path.chmod(0o755)
    jobs = tmp_path / "jobs"
    environment = {
        **os.environ,
        "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
        "JOBS": str(jobs),
    }
    flags = ["--frames", "4", "--size", "32x18", "--flood.level", "0.2 m"]
    command = ["bash", str(EXAMPLE), str(run_folder), str(out), "3", *flags]
    subprocess.run(command, check=True, env=environment, capture_output=True)
    assert (out / "movie.mp4").is_file() and (out / "movie.json").is_file()
    lines = jobs.read_text().splitlines()
    assert len(lines) == 5 and "--dependency=afterok:4711" in lines
    assert "--part" not in lines[-1] and lines[-1].rstrip().endswith("--join")
    assert {path.name for path in (out / "logs").iterdir()} == {
        *("1.log", "2.log", "3.log", "join.log")
    }
