"""Figures, with matplotlib, an extra."""

from __future__ import annotations

import io
import re
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from trigpoint.errors import ConfigError
from trigpoint.output import check_output, write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

PICTURES = (".png", ".svg", ".pdf")


def require_matplotlib() -> None:
    """Refuse to draw where matplotlib is not installed; best before the work."""
    if find_spec("matplotlib") is None:
        raise ConfigError(
            "drawing needs matplotlib; install it with: pip install 'trigpoint[plots]'"
        )


def make_figure(
    width_in: float,
    height_in: float,
    *,
    layout: Literal["constrained", "compressed"] = "constrained",
) -> Figure:
    """Make an empty figure."""
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((width_in, height_in), dpi=150, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def check_picture(path: Path | None, *inputs: Path) -> None:
    """Refuse, before any work is done, a picture that cannot be drawn or must not be written."""
    if path is None:
        return
    check_output(path, *inputs)
    if path.suffix.lower() not in PICTURES:
        raise ConfigError(f"cannot draw {path}; name it {' or '.join(PICTURES)}")
    require_matplotlib()


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as the kind of picture that the file's name ends in."""
    check_picture(path)
    file = io.BytesIO()
    figure.savefig(file, format=path.suffix[1:].lower(), bbox_inches="tight", pad_inches=0.1)
    write_atomically(path, file.getvalue())


def scale_logarithmically(axes: Axes, which: Literal["x", "y"] = "x") -> None:
    """Make an axis that has anything on it logarithmic, labelled 0.1, 0.2, 0.5, 1 ...

    A longer one is labelled 0.1, 0.3, 1 ..., and a long one 0.1, 1, 10 ...
    """
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis: Axis = axes.xaxis if which == "x" else axes.yaxis
    if not axis.get_data_interval()[1] > 0:
        return
    axes.set(**{f"{which}scale": "log"})
    low, high = axis.get_view_interval()
    steps = (1, 2, 5) if high <= 100 * low else (1, 3) if high <= 1000 * low else (1,)
    axis.set_major_locator(LogLocator(subs=steps))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def to_svg(figure: Figure) -> str:
    """Return a figure as an SVG element for a page: what is black takes the text's color there."""
    import matplotlib as mpl

    file = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "trigpoint"}):
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    svg = file.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r'<g id="[^"]*">', "<g>", svg)  # the same in every figure of a page
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    # Texts without a color are black, too.
    svg = svg.replace("<svg ", '<svg fill="currentColor" ', 1)
    return re.sub(r"#000000|\bblack\b", "currentColor", svg)
