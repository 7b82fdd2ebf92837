"""A signal ends a verb, also while the main thread cannot react."""

import signal
import subprocess
import sys
import time

import pytest

# A shell lets jobs in the background ignore SIGINT, and their children inherit that.
BUSY = """
import hashlib, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from climatenerf.cli import interruption
interruption.SECONDS_TO_REACT = 0.5
received = []
with interruption.stopped_like_ctrl_c(received):
    print("ready", flush=True)
    try:
        {work}
    except KeyboardInterrupt:
        time.sleep(1.5)  # what a verb does at its end, such as saving, may take longer
        print("saved", flush=True)
        sys.exit(128 + received[0])
"""
# One call of a library that lets other threads run, and no handler of signals.
DEAF = "hashlib.pbkdf2_hmac('sha256', b'a', b'b', 10**9)"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(("work", "saved"), [(DEAF, False), ("time.sleep(60)", True)])
def test_a_signal_ends_the_process_with_its_status(work, saved, number):
    child = subprocess.Popen(
        [sys.executable, "-c", BUSY.format(work=work)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None and child.stdout.readline() == "ready\n"
    time.sleep(0.2)
    child.send_signal(number)
    out, err = child.communicate(timeout=30)
    assert child.returncode == 128 + number
    assert ("saved" in out) == saved
    assert err == ("" if saved else "\nclimatenerf: interrupted\n")


def test_other_signals_and_the_end_of_the_block_leave_the_process_alone():
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import signal, time\n"
            "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
            "from climatenerf.cli import interruption\n"
            "interruption.SECONDS_TO_REACT = 0.2\n"
            "signal.signal(signal.SIGUSR1, lambda *_: print('own handler'))\n"
            "for _ in range(2):\n"
            "    with interruption.stopped_like_ctrl_c([]):\n"
            "        signal.raise_signal(signal.SIGUSR1)\n"
            "        time.sleep(0.5)\n"
            "print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)\n",
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and done.stderr == ""
    assert done.stdout.split("\n")[:3] == ["own handler", "own handler", "True"]
