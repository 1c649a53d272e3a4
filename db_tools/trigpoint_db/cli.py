"""The command `trigpoint-db`."""

from __future__ import annotations

import signal
import sys

import threadpoolctl
import typer

from trigpoint.errors import TrigpointError
from trigpoint_db.commands import (
    build,
    coverage,
    datasets,
    experiments,
    fleet,
    maps,
    networks,
    recordings,
    report,
    results,
    scenes,
    survey,
)

app = typer.Typer(
    help="Off-line tools on maps, recordings and results.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for commands in (
    build,
    results,
    maps,
    survey,
    coverage,
    report,
    datasets,
    recordings,
    networks,
    fleet,
):
    app.add_typer(commands.app)  # on the same level
experiments.app.add_typer(scenes.app)
app.add_typer(experiments.app, name="experiment")


@app.callback()
def _set_up() -> None:
    # As in the daemon: OpenBLAS's threads spin while they wait for each other.
    threadpoolctl.threadpool_limits(1, user_api="blas")


def main() -> None:
    """Run the command; an error is one line and exit code 1."""
    # So that what is half done is cleaned up.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        app()
    except TrigpointError as error:
        sys.exit(f"trigpoint-db: {error}")
    except OSError as error:  # a folder that cannot be entered, a name too long, a full disk
        sys.exit(f"trigpoint-db: {error.filename or 'output'}: {error.strerror}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
