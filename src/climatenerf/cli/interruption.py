"""The end of a verb by a signal: Ctrl-C, `kill`, or a closed terminal."""

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator

from climatenerf.cli import streams

SECONDS_TO_NEXT_SIGNAL = 0.05
"""After which a signal is repeated whose exception Python has dropped."""
SECONDS_TO_REACT = 8.0
"""After which a signal ends the process if nothing has happened."""


@contextlib.contextmanager
def stopped_like_ctrl_c(received: list[int]) -> Iterator[None]:
    """Let `kill` and a closed terminal end a verb as Ctrl-C does: with clean-up and a message.

    Args:
        received: gets the number of each signal.
    """

    def stop(number: int, frame: object) -> None:
        received.append(number)
        raise KeyboardInterrupt(number)

    def stop_again(unraisable: "sys.UnraisableHookArgs") -> None:
        # Python drops an exception that leaves a finaliser or a callback, of imports too.
        if isinstance(unraisable.exc_value, KeyboardInterrupt) and received:
            timer = threading.Timer(SECONDS_TO_NEXT_SIGNAL, _interrupt_main_thread, received[-1:])
            timer.daemon = True
            timer.start()
        else:
            hook(unraisable)

    replaced = {}
    hook, sys.unraisablehook = sys.unraisablehook, stop_again
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # Windows lacks the last
            number = getattr(signal, name, None)
            # Ignored signals (nohup) and foreign handlers stay as they are.
            usual = (signal.SIG_DFL, signal.default_int_handler)
            if number is not None and (handler := signal.getsignal(number)) in usual:
                replaced[number] = handler
                signal.signal(number, stop)
    try:
        with _ended_by_force(received, set(replaced)) if replaced else contextlib.nullcontext():
            yield
    finally:
        sys.unraisablehook = hook
        for number, handler in replaced.items():
            signal.signal(number, handler)


def _interrupt_main_thread(number: int) -> None:
    if hasattr(signal, "pthread_kill"):  # it also ends a wait of the main thread
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        signal.raise_signal(number)


@contextlib.contextmanager
def _ended_by_force(received: list[int], numbers: set[int]) -> Iterator[None]:
    """End the process if a signal stays without effect for `SECONDS_TO_REACT`.

    Python runs its handlers between two instructions of the main thread. The compiler of a kernel
    may be a single one for twenty seconds. The number of a signal is written to a socket at once,
    where a thread waits for it. Files are replaced as a whole, so none is left in between.

    Args:
        received: numbers of the signals whose handler has run.
        numbers: of the signals that end the process.
    """
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)

    def wait() -> None:
        with contextlib.suppress(OSError):  # closed at the end of the verb
            while number := reader.recv(1):
                if number[0] in numbers:
                    time.sleep(SECONDS_TO_REACT)
                    if not received:
                        streams.complain("\nclimatenerf: interrupted\n")
                        os._exit(128 + number[0])

    thread = threading.Thread(target=wait, name="watch for signals", daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        writer.close()  # the thread reads the end, and returns
        if not received:
            thread.join(SECONDS_TO_REACT)
        reader.close()
