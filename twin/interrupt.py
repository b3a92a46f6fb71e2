"""Ctrl-C and a request to terminate, heard at once but acted on only where Python can take it.

An exception out of a signal handler gets lost inside the import of an extension module, or comes out as that
module's own failure. So while anything is being imported the signal is only noted, and raised right after.
This file imports nothing slow: it works before the rest of twin is there.
"""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_AGAIN_S = 0.02


class _State:
    asked = False
    raised = False
    again = False  # the next signal is our own reminder
    guards = 0


@contextmanager
def guarded() -> Iterator[None]:
    """Turn SIGINT and SIGTERM into a `KeyboardInterrupt` within the block, but never inside an import."""
    if threading.current_thread() is not threading.main_thread():  # signals do not arrive here anyway
        yield
        return
    if _State.guards == 0:
        _State.asked = _State.raised = _State.again = False
    # What is ignored stays so: a shell does that for a job in the background.
    kept = {number: signal.getsignal(number) for number in _SIGNALS}
    kept = {number: handler for number, handler in kept.items() if handler is not signal.SIG_IGN}
    for number in kept:
        signal.signal(number, _heard)
    _State.guards += 1
    try:
        yield
    finally:
        _State.guards -= 1
        for number, handler in kept.items():
            signal.signal(number, handler)


def asked() -> bool:
    """Return whether a signal has come since the outermost guard began."""
    return _State.asked


def stop_if_asked() -> None:
    """Raise `KeyboardInterrupt` where a signal has come, even if somebody swallowed the first one."""
    if _State.asked:
        _State.raised = True
        raise KeyboardInterrupt


def _heard(number: int, frame: FrameType | None) -> None:
    reminded, _State.again = _State.again, False
    if reminded and _State.raised:  # `stop_if_asked` was sooner: leave what cleans up alone
        return
    _State.asked = True
    if not _importing(frame):
        _State.raised = True
        raise KeyboardInterrupt
    timer = threading.Timer(_AGAIN_S, _repeat, (signal.Signals(number),))
    timer.daemon = True
    timer.start()


def _repeat(number: signal.Signals) -> None:
    if _State.guards and not _State.raised:
        _State.again = True
        _thread.interrupt_main(number)


def _importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
