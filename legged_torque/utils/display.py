"""Progress of long work: on a terminal a view that is redrawn in place, elsewhere plain lines."""

from __future__ import annotations

import contextlib
import math
import os
import re
import sys
import time
from collections.abc import Callable
from datetime import timedelta
from typing import TYPE_CHECKING, ClassVar, TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import BarColumn, Progress, Task, TextColumn
from rich.segment import SegmentLines
from rich.text import Text

from legged_torque.utils.interrupt import write_error

if TYPE_CHECKING:
    from typing_extensions import Self

REDRAW_EVERY = 1.0  # seconds between two views; drawing one takes about 5 ms
LINE_EVERY = 10.0  # seconds between two plain lines
SPEED_OVER = 600.0  # seconds over which the speed is averaged
_UNKNOWN = "time left unknown"
_PROGRESS = re.compile(rf"([\w, ]+?) (\d+) of (\d+), (?:\d+ days?, )?[\d:]+, (?:{_UNKNOWN}|(\S.*?) left)")


class Display:
    """Shows the progress of some work while this context is open.

    On a terminal a thread of rich draws the :meth:`view`, below all that is printed meanwhile, so the lists and
    dictionaries in it must be replaced, not changed. Elsewhere the :meth:`line` is printed now and then. Nothing waits
    for a device, and no error in drawing ends the work. A display inside another one has no view.

    Attributes:
        total: Number to count to.
        done: Number that is reached; set this to count.
        bar: rich's bar, with a single task, which is updated when it is shown.
        activity: An unusual activity, shown as long as it is set.
        notice: The last text of :meth:`notify`.
        warnings: The texts of :func:`warn` since the start.
    """

    shown: ClassVar[Display | None] = None  # the display whose view is on the terminal

    def __init__(
        self,
        what: str,
        total: int,
        done: int = 0,
        stream: TextIO | None = None,
        stays: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare; nothing is shown before the context is opened.

        Args:
            what: Name of what is counted, e.g. "iteration".
            total: Number to count to.
            done: Number that is reached already.
            stream: Where to show it; None is standard output.
            stays: Whether the last view or line is left behind.
            clock: Returns the time [s].
        """
        self.total, self.done, self._what = total, done, what
        columns = (TextColumn("{task.description}", markup=False), BarColumn(None), TextColumn("{task.fields[times]}"))
        self.bar = Progress(*columns, expand=True, get_time=clock, speed_estimate_period=SPEED_OVER)
        self._id = self.bar.add_task("", start=False, total=total, completed=done, times="")
        self._stream, self._stays, self._clock = stream or sys.stdout, stays, clock
        self.activity = self.notice = ""
        self.warnings: tuple[str, ...] = ()
        self._console = Console()
        self._live: Live | None = None
        self._printed = -math.inf
        self._is_new = False  # whether there is a state that has not been printed

    def update_bar(self) -> Task:
        """Update the bar, and return its task: how fast the work is, and how long the rest will take."""
        text, task = f"{self._what} {self.done} of {self.total}", self.bar.tasks[0]
        self.bar.update(self._id, completed=self.done, description=text)
        task.fields["times"] = f"{math.floor(task.percentage):3}% {times(task)}"  # 100% only when all is done
        return task

    def view(self) -> RenderableType:
        """Return the view for a terminal."""
        self.update_bar()
        texts = filter(None, (self.activity, self.notice))
        return Group(self.bar.get_renderable(), *(Text(text, "yellow") for text in texts))

    def line(self) -> str:
        """Return the line that is printed elsewhere."""
        task = self.update_bar()
        return "; ".join(filter(None, (f"{task.description}, {times(task)}", self.activity)))

    def __enter__(self) -> Self:
        """Begin to show."""
        self.bar.start_task(self._id)
        self._printed = self._clock()
        if is_terminal(self._stream) and Display.shown is None:
            Display.shown = self
            self._console = Console(file=self._stream, highlight=False, markup=False)
            self._live = Live(
                console=self._console,
                refresh_per_second=1.0 / REDRAW_EVERY,
                transient=not self._stays,
                redirect_stdout=is_terminal(sys.stdout),
                redirect_stderr=is_terminal(sys.stderr),
                get_renderable=self._safe_view,
            )
            self._live.start(refresh=True)
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        """Show the last state if it shall stay, and end."""
        if self._live is not None:
            Display.shown = None
            with contextlib.suppress(OSError):  # the terminal is gone
                self._live.stop()
            self._live = None
        elif self._stays and self._is_new and kind is None:
            self.show(every=0.0)

    @property
    def width(self) -> int:
        """Width of views [characters]: that of the terminal, without the two in which Ctrl-C is shown."""
        return self._console.width - 2

    def show(self, every: float = LINE_EVERY) -> None:
        """Print the line if there is no view, and the last line was printed at least so long ago [s]."""
        now, self._is_new = self._clock(), True
        if self._live is None and now - self._printed >= every:
            self._printed = math.inf  # nothing more after an error: the output is not read any more
            print(self.line(), file=self._stream, flush=True)
            self._printed, self._is_new = now, False

    def notify(self, text: str) -> None:
        """Show a notice; the handler of a signal may call this."""
        self.notice = text
        if self._live is None:
            write_error(text)

    def _safe_view(self) -> RenderableType:
        """Return the view, or why there is none."""
        try:
            options = self._console.options.update(width=self.width)
            return SegmentLines(self._console.render_lines(self.view(), options, pad=False), new_lines=True)
        except Exception as error:  # of any number or name that is shown
            return Text(f"nothing to see: {type(error).__name__}: {error}")


class Counter(Display):
    """A bar for work that is counted, on standard error; gone when the work is done.

    ``with Counter("rendering frame", 250) as counter: ... counter.add()``
    """

    def __init__(self, what: str, total: int, clock: Callable[[], float] = time.monotonic) -> None:
        """Prepare to count to ``total``; ``what`` names what is counted."""
        super().__init__(what, total, stream=sys.stderr, clock=clock)

    def add(self) -> None:
        """Count one more."""
        self.done += 1
        if self.done == 1:  # it may have compiled kernels, so time counts from here on
            self.bar.reset(self._id)
            self._printed = self._clock()
            self.update_bar()
        self.show()


def times(task: Task) -> str:
    """Return the times spent and left: "0:00:01, 0:00:03 left"."""
    left = task.time_remaining
    return f"{duration(task.elapsed or 0.0)}, {_UNKNOWN if left is None else f'{duration(left)} left'}"


def read_progress(text: str) -> tuple[str, int, int, str] | None:
    """Return the content of the last :meth:`Display.line` in a text: what, done, total, and the time left or ""."""
    found = _PROGRESS.findall(text)
    return (found[-1][0].strip(), int(found[-1][1]), int(found[-1][2]), found[-1][3]) if found else None


def duration(seconds: float) -> str:
    """Return a time in hours, minutes and seconds."""
    return str(timedelta(seconds=round(seconds)))


def warn(text: str) -> None:
    """Print a warning on standard error; a view that is shown counts it."""
    print(f"Warning: {text}.", file=sys.stderr, flush=True)
    if (shown := Display.shown) is not None:
        shown.warnings += (text,)


def is_terminal(stream: TextIO) -> bool:
    """Return whether a stream is a terminal on which views can be drawn: one that knows Unicode, and is not dumb."""
    has_unicode = (stream.encoding or "utf-8").lower().startswith("utf")
    return stream.isatty() and has_unicode and os.environ.get("TERM", "dumb") not in ("dumb", "unknown")
