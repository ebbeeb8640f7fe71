"""What a script shows while it works: on a terminal a picture that is redrawn in place, elsewhere plain lines."""

from __future__ import annotations

import contextlib
import math
import os
import re
import sys
import threading
import time
from collections import deque
from datetime import timedelta
from types import TracebackType
from typing import TYPE_CHECKING, ClassVar, TextIO

from rich.console import Console, Group, RenderableType
from rich.constrain import Constrain
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from legged_torque.utils.interrupt import write_error

if TYPE_CHECKING:
    from typing_extensions import Self

REDRAW_EVERY = 1.0  # seconds between two pictures while the work goes on; one takes about 5 ms
REDRAW_WAITING = 2.0  # likewise while nothing is new, so that the clock goes on; longer, or it would take the turns
LINE_EVERY = 10.0  # seconds between two plain lines
_POLL = 0.25
_UNKNOWN = "time left unknown"
_PROGRESS = re.compile(rf"([\w, ]+?) (\d+) of (\d+), (?:\d+ days?, )?[\d:]+, (?:{_UNKNOWN}|(\S.*?) left)")


class Display:
    """Shows how far some work is, while this context is open.

    On a terminal that is the :meth:`picture`, below all that is printed meanwhile; elsewhere the :meth:`line` is
    printed now and then. Nothing waits for a device. Subclasses say what both look like. Another thread may ask for a
    picture, so what it is made from is replaced as a whole. Only one picture is shown at a time: a display inside
    another one prints lines.

    Attributes:
        activity: What the work does just now, if that is not the usual.
        notice: What has been told by :meth:`tell`.
        warnings: What :func:`warn` has told since the start.
    """

    shown: ClassVar[Display | None] = None  # the display whose picture is on the terminal

    def __init__(self, stream: TextIO | None = None, stays: bool = False) -> None:
        """Prepare; nothing is shown before the context is opened.

        ``stream`` is standard output unless given. If the display ``stays``, its last picture or line is left behind.
        """
        self._stream, self._stays = stream or sys.stdout, stays
        self.activity = self.notice = ""
        self.warnings: tuple[str, ...] = ()
        self._live: Live | None = None
        self._drawn, self._drawn_notice = -math.inf, ""
        self._printed = self.start = time.monotonic()
        self._is_new = False  # whether there is a state that has not been printed
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="display", daemon=True)

    def picture(self) -> RenderableType:
        """Return what a terminal shows now."""
        raise NotImplementedError

    def line(self) -> str:
        """Return the line that is printed elsewhere."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        """Begin to show."""
        self._printed = self.start = time.monotonic()
        if is_terminal(self._stream) and Display.shown is None:
            Display.shown = self
            console = Console(
                file=self._stream, force_terminal=True, force_interactive=True, highlight=False, markup=False
            )
            self._live = Live(
                console=console,
                auto_refresh=False,
                transient=not self._stays,
                redirect_stdout=is_terminal(sys.stdout),
                redirect_stderr=is_terminal(sys.stderr),
                get_renderable=self._shown_picture,
            )
            self._live.start()
            self._draw()
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Show the last state if it shall stay, and end."""
        if self._live is not None:
            self._end.set()
            self._thread.join()
            Display.shown = None
            with contextlib.suppress(OSError):  # the terminal is gone
                self._live.stop()
            self._live = None
        elif self._stays and self._is_new and kind is None:
            self.update(line_every=0.0)

    @property
    def width(self) -> int:
        """Width of pictures [characters]: that of the terminal, but for the two that show Ctrl-C."""
        return self._live.console.width - 2 if self._live is not None else 80

    def is_due(self) -> bool:
        """Return whether there is a picture, and it is time to redraw it."""
        return self._live is not None and time.monotonic() - self._drawn >= REDRAW_EVERY

    def update(self, line_every: float = LINE_EVERY) -> None:
        """Show the present state, if the last one was shown long enough ago [s]."""
        now, self._is_new = time.monotonic(), True
        if self.is_due():
            self._draw()
        elif self._live is None and now - self._printed >= line_every:
            self._printed = math.inf  # nothing more if this fails: nobody reads
            print(self.line(), file=self._stream, flush=True)
            self._printed, self._is_new = now, False

    def tell(self, text: str) -> None:
        """Show a notice at once; a signal's handler may call this."""
        self.notice = text
        if self._live is None:
            write_error(text)

    def _shown_picture(self) -> RenderableType:
        """Return the picture as wide as it may be, or why there is none: that must not end the work."""
        try:
            return Constrain(self.picture(), self.width)
        except Exception as error:  # whatever a number or a name brings about
            return Text(f"no picture: {type(error).__name__}: {error}")

    def _draw(self) -> None:
        """Redraw the picture."""
        self._drawn, self._drawn_notice = time.monotonic(), self.notice
        live = self._live
        with contextlib.suppress(OSError):  # the terminal is gone, which a signal tells
            if live is not None:
                live.refresh()

    def _watch(self) -> None:
        """Redraw while nobody calls :meth:`update`, and after a notice."""
        while not self._end.wait(_POLL):
            is_late = time.monotonic() - self._drawn >= REDRAW_WAITING
            if is_late or self.notice != self._drawn_notice:
                self._draw()


class Counter(Display):
    """A bar for work that is counted, on standard error; gone when the work is done.

    ``with Counter("rendering frame", 250) as counter: ... counter.add()``
    """

    def __init__(self, what: str, total: int) -> None:
        """Prepare to count ``total`` of what is named."""
        super().__init__(sys.stderr)
        self._what, self._pace, self._detail = what, Pace(total), ""

    def add(self, detail: str = "") -> None:
        """Count one more, and keep what is to be said about it."""
        if self._pace.done == 0:
            self._printed = self.start = time.monotonic()  # the first one may have compiled kernels
        self._detail = detail or self._detail
        self._pace.add(self._pace.done + 1)
        self.update()

    def picture(self) -> RenderableType:
        """Return the bar."""
        seconds = time.monotonic() - self.start
        progress = bar(f"{self._what} {self._pace}", self._pace.share, seconds, self._pace.left())
        further = filter(None, (self._detail, self.activity, self.notice))
        return Group(progress, *(Text(text, style="dim") for text in further))

    def line(self) -> str:
        """Return how far the work is."""
        text = progress_text(self._what, self._pace, time.monotonic() - self.start)
        return "; ".join(filter(None, (text, self._detail)))


class Pace:
    """How fast something is counted, by the last hundred moments of at least 10 ms, and how long the rest will take.

    Attributes:
        done: How many are done.
        total: How many there are.
    """

    def __init__(self, total: int, done: int = 0) -> None:
        """Start to count."""
        self.total, self.done = total, done
        self._moments: deque[tuple[float, int]] = deque(maxlen=100)

    def __str__(self) -> str:
        """Say how many are done."""
        return f"{self.done} of {self.total}"

    @property
    def share(self) -> float:
        """Share of all that is done, 0 to 1."""
        return self.done / max(self.total, 1)

    def add(self, done: int) -> None:
        """Note that so many are done now."""
        self.done, now = done, time.monotonic()
        if not self._moments or now - self._moments[-1][0] >= 0.01:
            self._moments.append((now, done))

    def per_second(self) -> float | None:
        """Return how many are done in a second; None if that is not known yet."""
        if len(self._moments) < 2:
            return None
        (start, first), (end, last) = self._moments[0], self._moments[-1]
        return (last - first) / (end - start)

    def left(self) -> float | None:
        """Return the time that the rest will take [s]; None if that is not known yet."""
        rate, rest = self.per_second(), self.total - self.done
        return rest / rate if rate else None if rest else 0.0


def bar(text: str, share: float, seconds: float, left: float | None) -> Table:
    """Return a line with a text, a bar for the share that is done, and the time spent [s] and left [s], if known."""
    grid = Table.grid(padding=(0, 1), expand=True)
    grid.add_column(no_wrap=True)
    grid.add_column(ratio=1)
    for _ in range(2):
        grid.add_column(no_wrap=True)
    times = f"{duration(seconds)}, {time_left_text(left)}"
    grid.add_row(text, ProgressBar(1.0, share), f"{math.floor(100.0 * share):3}%", times)
    return grid


def progress_text(what: str, pace: Pace, seconds: float) -> str:
    """Return how far something is and the time spent [s] and left: "iteration 5 of 20, 0:00:01, 0:00:03 left"."""
    return f"{what} {pace}, {duration(seconds)}, {time_left_text(pace.left())}"


def time_left_text(left: float | None) -> str:
    """Return how long something takes still [s]; None is unknown."""
    return _UNKNOWN if left is None else f"{duration(left)} left"


def read_progress(text: str) -> tuple[str, int, int, str] | None:
    """Return what the last :func:`progress_text` in a text says: what, done, total, and the time left or ""."""
    found = _PROGRESS.findall(text)
    return (found[-1][0].strip(), int(found[-1][1]), int(found[-1][2]), found[-1][3]) if found else None


def duration(seconds: float) -> str:
    """Return a time in hours, minutes and seconds."""
    return str(timedelta(seconds=round(seconds)))


def warn(text: str) -> None:
    """Print a warning on standard error; a picture that is shown counts it."""
    print(f"Warning: {text}.", file=sys.stderr, flush=True)
    shown = Display.shown
    if shown is not None:
        shown.warnings += (text,)


def is_terminal(stream: TextIO) -> bool:
    """Return whether a stream is a terminal on which pictures can be drawn: one that knows Unicode and no dumb one."""
    has_unicode = (stream.encoding or "utf-8").lower().startswith("utf")
    return stream.isatty() and has_unicode and os.environ.get("TERM", "dumb") not in ("dumb", "unknown")
