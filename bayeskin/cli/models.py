"""The commands that run a single model: `simulate`, `reduce` and `serve`."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from bayeskin.cli.answers import answered, print_answer
from bayeskin.cli.options import PATH, device_option, json_option, scheduler_option
from bayeskin.cli.terminal import Terminal


@click.command(short_help="Run the full model once on a recording's displacement.")
@click.argument("config", required=False, type=PATH)
@click.option("--recording", type=PATH, help="Recording whose displacement drives the run.")
@click.option(
    "--set", "settings", multiple=True, metavar="NAME=VALUE", help="A parameter in SI units; repeatable."
)
@click.option(
    "--mechanism", "mechanisms", multiple=True, metavar="NAME", help="Mechanism to add; repeatable."
)
@device_option
@click.option("--mesh", help="'bricks' or a gmsh file; default as in CONFIG.")
@click.option("--observation", type=click.Choice(["reaction", "article"]), help="Default as in CONFIG.")
@click.option("-o", "out", required=True, type=PATH, help="File to write: .csv or .h5.")
@click.option(
    "--reduced", is_flag=True, help="Run the reduced model of the device instead of the full model."
)
@click.option("--fields", type=PATH, help="Folder for the fields over time (ParaView).")
@click.option("--figures", type=PATH, help="Folder for a figure of the fields.")
@click.option(
    "--at",
    "at_s",
    multiple=True,
    type=float,
    metavar="SECONDS",
    help="Time that the figure shows; repeatable.",
)
@answered
def simulate(**options: Any) -> Mapping[str, Any]:
    """Run the full model once on a recording's displacement (default: the demo's).

    Parameters that are not set have the median of their prior; this includes the parameters of mechanisms.
    The CSV file has the columns time_s, displacement_m, force_n.

    With --reduced, the reduced model of the device runs instead. It is many times faster, and the command
    reports an estimate of its error. The command uses the reduced model that `bayeskin reduce` wrote beside
    CONFIG or the device's file, or the shipped model of the article's device. If the run leaves the range
    that the model was trained for, the command says so and exits with code 1.

    The figure (fields.png, fields.svg) shows displacement, pressure and fluid velocity near the pads. It
    shows them at the times given by --at, which can be repeated. The default is four moments: the end of the
    first loading, the middle of its hold, the end of its unloading, and the middle of the last phase.

    \b
    Example:
      bayeskin simulate --set E_c=300e3 --set k_s=1e-13 -o force.csv --fields fields
      bayeskin simulate -o force.csv --figures figures --at 14.4 --at 30 --at 54.4
      bayeskin simulate -o force.csv --mechanism device-friction --set Fc=0.03
      bayeskin simulate --reduced -o force.csv --mechanism solid-viscoelasticity --json
      bayeskin simulate -o force.csv --device device.toml
    """
    from bayeskin.workflow.simulating import SimulationRequest, simulate_once

    with Terminal() as terminal:
        return simulate_once(SimulationRequest(**options), terminal)


@click.command("reduce", short_help="Build the reduced model of a device: once, for all protocols.")
@click.argument("source", required=False, type=PATH)
@click.option("-o", "out", type=PATH, help="HDF5 file to write; default: beside SOURCE.")
@scheduler_option
@answered
def reduce_(source: Path | None, out: Path | None, scheduler: str | None) -> Mapping[str, Any]:
    """Build the reduced model of a device: once, for all protocols.

    SOURCE is a configuration, or a file with the sections [device] and [tissue]; the default is the article's
    device. The base model is built first, and can be used while the mechanisms are added. Training runs of
    the full model are stored, so that the command can be interrupted and started again.

    \b
    Example:
      bayeskin reduce device.toml
      bayeskin reduce device.toml -o device-reduced.h5 --scheduler tcp://10.0.0.5:8786
    """
    from bayeskin.workflow.reducing import reduce

    with Terminal() as terminal:
        return reduce(source, out, terminal, scheduler)


@click.command(short_help="Serve the full model to other tools by UM-Bridge.")
@click.argument("config", required=False, type=PATH)
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen at.")
@click.option(
    "--port", default=4242, show_default=True, type=click.IntRange(0, 65535), help="Port; 0 takes a free one."
)
@json_option
def serve(config: Path | None, host: str, port: int, as_json: bool) -> None:
    """Serve the forward model by UM-Bridge, for other tools of uncertainty quantification.

    The server offers the model of CONFIG (default: the demo's) on the protocol of its recording until Ctrl-C.
    The input is one vector of the parameters in SI units. The output is one vector of the mean force [N] in
    each bin of the recording. A request's config can ask for another protocol, for other bins or times, and
    for mechanisms. By default, only this machine can reach the server. With --host, other machines can reach
    it, and no password protects it.

    \b
    Example:
      bayeskin serve runs/demo.toml --port 4242
      bayeskin serve runs/demo.toml --port 0 --json
    """
    from bayeskin.workflow.serve import open_server

    with Terminal() as terminal:
        server, document = open_server(config, host, port, terminal)
    print_answer(document, as_json)
    with server, suppress(KeyboardInterrupt):
        server.serve_forever()
