"""The command line: each command parses its options, calls a function and prints the answer.

Exit code 0 means done, 1 that the answer failed or cannot be trusted, 2 that the input is wrong, and 130 that
the command was interrupted.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

import click

import bayeskin
from bayeskin.errors import InputError
from bayeskin.terminal import NOT_TRUSTED, Terminal, exit_code

# The matrices are small, so several threads of linear algebra would slow the program down. The linear algebra
# libraries read these variables when numpy is imported, so they are set before.
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

as_json = click.option("--json", "as_json", is_flag=True, help="Print one JSON document on stdout.")
a_config = click.argument("config", type=click.Path(path_type=Path))
a_device = click.option(
    "--device", type=click.Path(path_type=Path), help="TOML file with [device] and [tissue]."
)


class _Workflow(click.Group):
    """A group of commands that lists them in the order in which a user needs them."""

    ORDER: ClassVar[dict[str, tuple[str, ...]]] = {
        "From a recording to an answer": ("doctor", "new", "import", "run", "diagnose", "report"),
        "Single stages": ("reduce", "design", "train", "map", "sample", "sobol"),
        "Further commands": ("experiment", "simulate", "serve", "prove", "conceal"),
    }

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Returns the names of all commands in that order."""
        return [name for names in self.ORDER.values() for name in names]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes the commands with their short help, section by section."""
        for title, names in self.ORDER.items():
            with formatter.section(title):
                rows = [(name, self.commands[name].get_short_help_str(formatter.width)) for name in names]
                formatter.write_dl(rows)


@click.group(
    cls=_Workflow, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(bayeskin.__version__, prog_name="bayeskin")
def cli() -> None:
    """Infer the properties of living skin from an extensometer test, and say how certain they are.

    \b
    Start here:
      bayeskin doctor                          check the installation
      bayeskin new && bayeskin run demo.toml   run all stages on the demo
      bayeskin new test.xlsx -o test.toml      write your own configuration
      bayeskin run test.toml                   run all stages on it

    \b
    This line makes your shell complete commands and options (zsh: zsh_source):
      eval "$(_BAYESKIN_COMPLETE=bash_source bayeskin)"
    """


@cli.command("import", short_help="Read a recording (xlsx, csv, tsv, h5), write it as HDF5.")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("-o", "out", required=True, type=click.Path(path_type=Path), help="HDF5 file to write.")
@click.option("--sheet", help="Sheet of a workbook, if several sheets have the columns.")
@as_json
def import_(file: Path, out: Path, sheet: str | None, as_json: bool) -> None:
    """Read a recording (xlsx, csv, tsv, h5) and write it in SI units as HDF5.

    The command finds the columns and their units, and reports how it interpreted them. It also reports the
    phases, the noise, the spikes and the steps that it detects.

    \b
    Example:
      bayeskin import Healthy_skin.xlsx -o runs/healthy-skin.h5
      bayeskin import series.xlsx --sheet "Test 3" -o runs/test-3.h5
    """
    from bayeskin.workflow import single

    _answer(single.import_recording(file, out, sheet), as_json)


@cli.command(short_help="Write a configuration for a recording of your own.")
@click.argument("recording", required=False, type=click.Path(path_type=Path))
@click.option(
    "-o", "out", type=click.Path(path_type=Path), help="TOML file to write; default: beside RECORDING."
)
@a_device
@as_json
def new(recording: Path | None, out: Path | None, device: Path | None, as_json: bool) -> None:
    """Write a commented configuration for your own recording; without RECORDING, write the demo's.

    The command reads the recording and reports what it contains. The configuration uses a shipped surrogate
    if one was trained on the recording's protocol, and a design of model runs otherwise. Existing files are
    never overwritten. The demo's recording is written beside its configuration. With --device, the sections
    [device] and [tissue] of that file are written into the configuration; without it, the article's device
    and tissue are used.

    \b
    Example:
      bayeskin new && bayeskin run demo.toml
      bayeskin new test.xlsx -o runs/test.toml --device device.toml
      bayeskin new runs/test.h5 && bayeskin run runs/test.toml
    """
    from bayeskin.workflow.new import new_config, new_demo

    if recording is None and device is not None:
        raise InputError(
            f"--device {device}", "no RECORDING", "a RECORDING, because the demo uses the article's device"
        )
    _answer(new_demo(out) if recording is None else new_config(recording, out, device), as_json)


a_scheduler = click.option(
    "--scheduler", metavar="ADDRESS", help="Dask scheduler that runs the full model, as tcp://HOST:PORT."
)


@cli.command("reduce", short_help="Build the reduced model of a device: once, for all protocols.")
@click.argument("source", required=False, type=click.Path(path_type=Path))
@click.option(
    "-o", "out", type=click.Path(path_type=Path), help="HDF5 file to write; default: beside SOURCE."
)
@a_scheduler
@as_json
def reduce_(source: Path | None, out: Path | None, scheduler: str | None, as_json: bool) -> None:
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
        document = reduce(source, out, terminal, scheduler)
    _answer(document, as_json)


@cli.command(short_help="Run the full model once on a recording's displacement.")
@click.argument("config", required=False, type=click.Path(path_type=Path))
@click.option(
    "--recording", type=click.Path(path_type=Path), help="Recording whose displacement drives the run."
)
@click.option(
    "--set", "settings", multiple=True, metavar="NAME=VALUE", help="A parameter in SI units; repeatable."
)
@click.option(
    "--mechanism", "mechanisms", multiple=True, metavar="NAME", help="Mechanism to add; repeatable."
)
@a_device
@click.option("--mesh", help="'bricks' or a gmsh file; default as in CONFIG.")
@click.option("--observation", type=click.Choice(["reaction", "article"]), help="Default as in CONFIG.")
@click.option("-o", "out", required=True, type=click.Path(path_type=Path), help="File to write: .csv or .h5.")
@click.option(
    "--reduced", is_flag=True, help="Run the reduced model of the device instead of the full model."
)
@click.option("--fields", type=click.Path(path_type=Path), help="Folder for the fields over time (ParaView).")
@click.option("--figures", type=click.Path(path_type=Path), help="Folder for a figure of the fields.")
@click.option(
    "--at",
    "at_s",
    multiple=True,
    type=float,
    metavar="SECONDS",
    help="Time that the figure shows; repeatable.",
)
@as_json
def simulate(as_json: bool, **options: Any) -> None:
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
    from bayeskin.workflow import single

    with Terminal() as terminal:
        document = single.simulate_once(reporter=terminal, **options)
    _answer(document, as_json)


def _stage_command(name: str, text: str, example: str = "runs/demo.toml") -> None:
    """Adds the command of a single stage; `text` and `example` appear in its help."""

    @cli.command(name, help=f"{text}\n\nEarlier stages that it needs run first.\n\n"
                            f"\b\nExample:\n  bayeskin {name} {example}\n"
                            f"  bayeskin {name} {example} --json")  # fmt: skip
    @a_config
    @a_scheduler
    @as_json
    def command(config: Path, scheduler: str | None, as_json: bool) -> None:
        _run(config, name, scheduler, as_json)


_stage_command("design", "Run the full model at the design's points, wave by wave.")
_stage_command("train", "Train the surrogate and validate it on held-out points.")
_stage_command("map", "Find the most probable point and check it with the full model.")
_stage_command("sample", "Sample the posterior and check it with the full model.")
_stage_command("sobol", "Compute Sobol' indices of the force over time.")


@cli.command()
@a_config
@as_json
def report(config: Path, as_json: bool) -> None:
    """Write one HTML page about a run, from the stages that are done.

    The command runs no stage, and lists the stages that are missing. The page is report.html in the run's
    folder. It needs no network and no other file, so it can be sent as a single file.

    \b
    Example:
      bayeskin report runs/demo.toml
      bayeskin report runs/demo.toml --json > answer.json
    """
    from bayeskin.workflow import stages

    with Terminal() as terminal:
        document = stages.report(config, terminal)
    _answer(document, as_json)


@cli.command(short_help="Run all stages of a configuration that are not done yet.")
@a_config
@a_scheduler
@as_json
def run(config: Path, scheduler: str | None, as_json: bool) -> None:
    """Run all stages of a configuration in order; skip those that are done and unchanged.

    Outputs are written to a folder beside CONFIG that has the configuration's name. Read report.html in this
    folder for the result. If the command is interrupted, the same command continues the run.

    \b
    Example:
      bayeskin run runs/demo.toml
      bayeskin run runs/test.toml --scheduler tcp://10.0.0.5:8786
    """
    _run(config, None, scheduler, as_json)


@cli.command(short_help="Find the physics that the model leaves out, and where.")
@click.argument("source", type=click.Path(path_type=Path))
@a_device
@as_json
def diagnose(source: Path, device: Path | None, as_json: bool) -> None:
    """Find the physics that the model leaves out of a recording, and where; show how the fit improves.

    SOURCE is a configuration, or a recording by itself, of any protocol. The reduced model of the device
    solves all mechanisms of a set together, and the full model checks the result. The likeliest sets are
    fitted again to the recording up to the end of its second hold, and tested on the rest of it. This takes
    two to ten minutes, and longer if many mechanisms act. For the article's observation, and for a forward
    model of your own, a surrogate is trained first, and mechanisms of the tissue are not tried. The exit code
    is 0 for every verdict.

    \b
    Example:
      bayeskin diagnose runs/healthy-skin.toml
      bayeskin diagnose runs/healthy-skin.h5 --json
      bayeskin diagnose first.h5 --device device.toml
    """
    from bayeskin.workflow import diagnosis

    with Terminal() as terminal:
        document = diagnosis.diagnose(source, terminal, device)
    _answer(document, as_json)


@cli.command(short_help="Propose a test that tells look-alike mechanisms apart.")
@click.argument("source", type=click.Path(path_type=Path))
@a_device
@as_json
def experiment(source: Path, device: Path | None, as_json: bool) -> None:
    """Propose the further test that would best tell look-alike mechanisms apart.

    SOURCE is the same as for `bayeskin diagnose`, which runs first if the diagnosis is not done. The command
    works for the reaction only, because no other protocol has the article's observation. The set that
    explains the recording best, and the sets with look-alikes in its place, are taken as equally probable.
    The reduced model of the device runs draws of their posteriors in other tests. The forces give the
    expected information, in bits, about which set is true. The command first tries nine variations of the
    recording's own test, and then changes of the most informative ones. All tests stay within the
    displacements and speeds that the reduced model was trained for.

    \b
    Example:
      bayeskin experiment runs/healthy-skin.toml
      bayeskin experiment first.h5 --device device.toml
    """
    from bayeskin.workflow import experiment

    with Terminal() as terminal:
        document = experiment.choose(source, terminal, device)
    _answer(document, as_json)


@cli.command(short_help="Measure how good diagnoses of concealed effects are.")
@click.argument("folder", required=False, type=click.Path(path_type=Path))
@click.option(
    "--at-most", type=click.IntRange(min=0), metavar="N", help="Diagnose at most N more, then score."
)
@click.option("--rediagnose", default=0, type=click.IntRange(min=0), metavar="N", help="Repeat N diagnoses.")
@as_json
def prove(folder: Path | None, at_most: int | None, rediagnose: int, as_json: bool) -> None:
    """Measure how good diagnoses are, on recordings with concealed effects whose keys are known.

    FOLDER is a set that `bayeskin conceal` made; the default is the shipped set. A recording that has a
    verdict is not diagnosed again, so the command can be interrupted. The keys are opened only after the
    verdicts are written. With --at-most, the recordings that are judged by then are scored. With
    --rediagnose, N of the recordings are diagnosed again, in a temporary folder. The exit code is 1 if one of
    these gets another verdict than the same sources gave before.

    \b
    Example:
      bayeskin prove --rediagnose 2
      bayeskin prove sets/one --at-most 4
    """
    from bayeskin.workflow import proof

    with Terminal() as terminal:
        document = proof.prove(folder, terminal, rediagnose, at_most)
    _answer(document, as_json)


@cli.command(short_help="Make a set of recordings for `bayeskin prove`.")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--seed", required=True, type=int, help="Random seed of the set.")
@click.option("--count", required=True, type=int, help="Number of recordings.")
@click.option(
    "--only", multiple=True, metavar="NAME", help="`nothing`, a mechanism or an effect outside the catalogue."
)
@as_json
def conceal(folder: Path, seed: int, count: int, only: tuple[str, ...], as_json: bool) -> None:
    """Make a set for `bayeskin prove`: recordings by the full model, with the effects' keys under seal.

    A set has recordings without any effect, with each mechanism, with pairs of mechanisms, and with effects
    that are outside the catalogue of mechanisms. With --only, which can be repeated, the set has only the
    named effects, in equal numbers. Their sizes then range from one to thirty noise floors, to show how large
    an effect must be to be detected. A finished recording is not made again. Each recording takes about half
    a minute, and two are made at once.

    \b
    Example:
      bayeskin conceal sets/one --seed 7 --count 24
      bayeskin conceal sets/none --seed 8 --count 80 --only nothing
      bayeskin conceal sets/sizes --seed 9 --count 16 --only pad-slip --only force-offset
    """
    from bayeskin.workflow import proof

    with Terminal() as terminal:
        document = proof.conceal(folder, seed, count, terminal, only)
    _answer(document, as_json)


@cli.command(short_help="Serve the full model to other tools by UM-Bridge.")
@click.argument("config", required=False, type=click.Path(path_type=Path))
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen at.")
@click.option(
    "--port", default=4242, show_default=True, type=click.IntRange(0, 65535), help="Port; 0 takes a free one."
)
@as_json
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
    _answer(document, as_json)
    sys.stdout.flush()
    with server, suppress(KeyboardInterrupt):
        server.serve_forever()


@cli.command(short_help="Check that this installation works.")
@as_json
def doctor(as_json: bool) -> None:
    """Check that this installation works in the current folder.

    The command checks the packages and their versions, the linear solver, the threads, the disk space and the
    write access. Then it compares a short run of the full model and a prediction of a surrogate with stored
    numbers. This takes about five seconds; the first time after the installation it takes half a minute,
    because parts are compiled. The exit code is 1 if something is broken.

    \b
    Example:
      bayeskin doctor
      bayeskin doctor --json
    """
    from bayeskin.workflow.doctor import examine

    _answer(examine(Path.cwd()), as_json)


def _run(config: Path, last: str | None, scheduler: str | None, as_json: bool) -> None:
    """Runs a configuration up to the stage `last` (None: all stages) and prints the answer."""
    from bayeskin.workflow import stages

    with Terminal() as terminal:
        document = stages.run(config, last, terminal, scheduler=scheduler)
    _answer(document, as_json)


def _answer(document: Mapping[str, Any], as_json: bool) -> None:
    """Prints the answer of a command as JSON or text; exits with code 1 where its ``ok`` is False."""
    try:
        click.echo(json.dumps(document, indent=2, allow_nan=False) if as_json else document["text"])
        sys.stdout.flush()
    except BrokenPipeError:  # the reading program ended early, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if not document["ok"]:
        raise click.exceptions.Exit(NOT_TRUSTED)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the `bayeskin` command with the given arguments (default: those of the process) and exits."""
    # Job schedulers end a job by SIGTERM, which is treated as Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(exit_code(lambda: cli.main(arguments, prog_name="bayeskin", standalone_mode=False)))
