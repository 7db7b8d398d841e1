"""What the command line says: results on standard output, everything else in lines on standard error."""

import contextlib
import shutil
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from typing import Any


def columns(heads: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> Iterator[str]:
    """A table as aligned lines."""
    widths = [max(len(row[i]) for row in [heads, *rows]) for i in range(len(heads))]
    for row in [heads, *rows]:
        cells = [
            text.rjust(w) if i in right else text.ljust(w) for i, (text, w) in enumerate(zip(row, widths, strict=True))
        ]
        yield "  ".join(cells).rstrip()


class Progress:
    """Stage and time left on standard error: a bar on a terminal where tqdm is installed, else one line a stage."""

    def __init__(self, quiet: bool) -> None:
        self.quiet, self.stage = quiet, ""
        self.bar: Any = None
        self.ended = threading.Event()

    def __enter__(self) -> "Progress":
        if not self.quiet and sys.stderr.isatty():
            with contextlib.suppress(ImportError):
                from tqdm import tqdm

                form = "{desc:<24}{percentage:3.0f} % |{bar}| {elapsed}, {remaining} left"
                # Some terminals say that they have no columns and no rows; 80 by 24 are taken then.
                wide, high = shutil.get_terminal_size()
                self.bar = tqdm(
                    desc="starting",
                    total=1.0,
                    bar_format=form,
                    leave=False,
                    file=sys.stderr,
                    ncols=wide - 1,
                    nrows=high,
                )
                threading.Thread(target=self._tick, daemon=True).start()
        return self

    def __call__(self, stage: str, share: float) -> None:
        """Says that `stage` is going on and which share of all the work is done."""
        if self.bar is not None:
            self.bar.set_description_str(stage, refresh=False)
            self.bar.update(max(share - self.bar.n, 0.0))
            self.bar.refresh()
        elif stage != self.stage:
            say(stage, self.quiet)
        self.stage = stage

    def __exit__(self, *_: object) -> None:
        self.ended.set()
        if self.bar is not None:
            self.bar.close()

    def _tick(self) -> None:
        """Keeps the clock going through a long stage."""
        while not self.ended.wait(1.0):
            self.bar.refresh()


@contextlib.contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Turns warnings meant for users into lines; leaves out those meant for programmers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = lambda message, *_, **__: say(f"warning: {message}")
        yield


def say(text: str, quiet: bool = False) -> None:
    """One line on standard error."""
    if not quiet:
        print(f"jaxfuzzy: {_plain(' '.join(text.split()), sys.stderr)}", file=sys.stderr, flush=True)


def show(text: str) -> None:
    """Lines on standard output."""
    print(_plain(text, sys.stdout))


def _plain(text: str, stream: Any) -> str:
    """The text, without what a terminal in another encoding cannot show."""
    try:
        text.encode(stream.encoding or "ascii")
    except UnicodeEncodeError:
        for sign, word in (("±", "+-"), ("°", " deg"), ("×", "x"), ("–", "-")):
            text = text.replace(sign, word)
        return text.encode(stream.encoding or "ascii", "replace").decode(stream.encoding or "ascii")
    return text
