"""The command line: parse, call, exit code. 0 done, 1 the answer is not to be trusted, 2 wrong input."""

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

# Its matrices are small: threads of linear algebra would cost more than they give. Read when numpy loads.
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

as_json = click.option("--json", "as_json", is_flag=True, help="Print one JSON document on stdout.")
a_config = click.argument("config", type=click.Path(path_type=Path))
a_device = click.option(
    "--device", type=click.Path(path_type=Path), help="TOML file with [device] and [tissue]."
)


class _Workflow(click.Group):
    """Lists its commands in the order in which a user needs them."""

    ORDER: ClassVar[dict[str, tuple[str, ...]]] = {
        "From a recording to an answer": ("doctor", "new", "import", "run", "diagnose", "report"),
        "Single stages": ("reduce", "design", "train", "map", "sample", "sobol"),
        "Further": ("experiment", "simulate", "serve", "prove", "conceal"),
    }

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [name for names in self.ORDER.values() for name in names]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for title, names in self.ORDER.items():
            with formatter.section(title):
                shown = [(name, self.commands[name].get_short_help_str(formatter.width)) for name in names]
                formatter.write_dl(shown)


@click.group(
    cls=_Workflow, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(bayeskin.__version__, prog_name="bayeskin")
def cli() -> None:
    """Infer the properties of living skin from an extensometer test, and say how sure they are.

    \b
    Start here:
      bayeskin doctor                          does it work here
      bayeskin new && bayeskin run demo.toml   everything, on the demo
      bayeskin new test.xlsx -o test.toml      a configuration for your own
      bayeskin run test.toml

    \b
    Your shell completes commands and options after (zsh: zsh_source)
      eval "$(_BAYESKIN_COMPLETE=bash_source bayeskin)"
    """


@cli.command("import", short_help="Read a recording (xlsx, csv, tsv, h5), write it as HDF5.")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("-o", "out", required=True, type=click.Path(path_type=Path), help="HDF5 file to write.")
@click.option("--sheet", help="Sheet of a workbook, where several hold the columns.")
@as_json
def import_(file: Path, out: Path, sheet: str | None, as_json: bool) -> None:
    """Read a recording (xlsx, csv, tsv, h5) and write it in SI units as HDF5.

    Finds the columns and their units and says what it took for what, and which phases, noise, spikes and
    steps it sees.

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
    """Write a commented configuration for a recording of your own; without RECORDING the demo, to try.

    Reads the recording, says what it found, and takes a shipped surrogate where one knows its protocol, else
    a design of full runs. Never writes over a file. The demo's recording comes with its configuration. With
    --device its sections [device] and [tissue] are written into the configuration; without, they are the
    article's.

    \b
    Example:
      bayeskin new && bayeskin run demo.toml
      bayeskin new test.xlsx -o runs/test.toml --device device.toml
      bayeskin new runs/test.h5 && bayeskin run runs/test.toml
    """
    from bayeskin.workflow.new import new_config, new_demo

    if recording is None and device is not None:
        raise InputError(f"--device {device}", "no RECORDING", "one: the demo is of the article's device")
    _answer(new_demo(out) if recording is None else new_config(recording, out, device), as_json)


a_scheduler = click.option(
    "--scheduler", metavar="ADDRESS", help="Dask scheduler that makes the full runs, as tcp://HOST:PORT."
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

    SOURCE is a configuration, or a file with the sections [device] and [tissue]; without it the article's
    device. The base model comes first, and can be used while the mechanisms follow. Training
    runs of the full model are kept, so that the command can be interrupted and goes on.

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
@click.option("--set", "settings", multiple=True, metavar="NAME=VALUE", help="A parameter, in SI units.")
@click.option("--mechanism", "mechanisms", multiple=True, metavar="NAME", help="Physics to add; repeatable.")
@a_device
@click.option("--mesh", help="'bricks' or a gmsh file; default as in CONFIG.")
@click.option("--observation", type=click.Choice(["reaction", "article"]), help="Default as in CONFIG.")
@click.option("-o", "out", required=True, type=click.Path(path_type=Path), help="File to write: .csv or .h5.")
@click.option("--reduced", is_flag=True, help="Run the device's reduced model in the full one's place.")
@click.option("--fields", type=click.Path(path_type=Path), help="Folder for the fields over time (ParaView).")
@click.option("--figures", type=click.Path(path_type=Path), help="Folder for a figure of the fields.")
@click.option("--at", "at_s", multiple=True, type=float, metavar="SECONDS", help="A time that it shows.")
@as_json
def simulate(as_json: bool, **options: Any) -> None:
    """Run the full model once on a recording's displacement (default: the demo's).

    Parameters that are not set stand at the median of their prior, a mechanism's among them. The CSV has the
    columns time_s, displacement_m, force_n.

    With --reduced the device's reduced model runs instead, many times faster, and says how large its error
    is: the one that `bayeskin reduce` made beside CONFIG or the device's file, or the shipped one of the
    article's device. Where the run leaves what it was trained for, it says so, and exits with 1.

    The figure (fields.png, fields.svg) shows displacement, pressure and fluid velocity near the pads at the
    times given by --at, which can be repeated, or at four moments: the end of the first loading, the middle
    of its hold, the end of its unloading, and the middle of the last phase.

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
    @cli.command(name, help=f"{text}\n\nWhat it needs of earlier stages is done first.\n\n"
                            f"\b\nExample:\n  bayeskin {name} {example}\n"
                            f"  bayeskin {name} {example} --json")  # fmt: skip
    @a_config
    @a_scheduler
    @as_json
    def command(config: Path, scheduler: str | None, as_json: bool) -> None:
        _run(config, name, scheduler, as_json)


_stage_command("design", "Run the full model at the design's points, wave by wave.")
_stage_command("train", "Train the surrogate on the design, validate it on held-out points.")
_stage_command("map", "Find the most probable point and check it by the full model.")
_stage_command("sample", "Sample the posterior, check it at draws; bands on the force.")
_stage_command("sobol", "Sobol' indices of the force over time.")


@cli.command()
@a_config
@as_json
def report(config: Path, as_json: bool) -> None:
    """Write one HTML page of a run, from the stages that are done.

    Runs no stage: says plainly which are missing. The page is report.html in the run's folder; it needs no
    network and no file beside it, so it can be sent as it is.

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

    Outputs go to a folder beside CONFIG with the configuration's name; report.html in it is the answer to
    read. Interrupted at any moment, the same command goes on.

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
    solves all mechanisms of a set together, and the full model checks what comes out. The likeliest sets are
    fitted once more to the recording up to the end of its second hold, and tested on what follows. That takes
    two to ten minutes, and longer where many mechanisms act. For the article's observation and a model of
    your own a surrogate is trained first, and mechanisms of the tissue are not tried. The exit code is 0
    whatever the verdict.

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


@cli.command(short_help="Propose the further test that tells look-alikes apart.")
@click.argument("source", type=click.Path(path_type=Path))
@a_device
@as_json
def experiment(source: Path, device: Path | None, as_json: bool) -> None:
    """Propose the further test that would best tell look-alike mechanisms apart.

    SOURCE as for `bayeskin diagnose`, which is run first where that is not done; the reaction only, since no
    other protocol has the article's observation. The set that explains the recording best and those with
    look-alikes in its place are taken as equally probable. The reduced model of the device runs draws of
    their posteriors in other tests, and the expected information about which is true, in bits, is computed
    from the forces. First come nine variations of the recording's own test, then changes of those that tell
    most, within the displacements and speeds that the reduced model knows.

    \b
    Example:
      bayeskin experiment runs/healthy-skin.toml
      bayeskin experiment first.h5 --device device.toml
    """
    from bayeskin.workflow import experiment

    with Terminal() as terminal:
        document = experiment.choose(source, terminal, device)
    _answer(document, as_json)


@cli.command(short_help="Measure how good diagnoses are, on concealed effects.")
@click.argument("folder", required=False, type=click.Path(path_type=Path))
@click.option("--at-most", type=click.IntRange(min=0), metavar="N", help="Diagnose N more, then score.")
@click.option("--rediagnose", default=0, type=click.IntRange(min=0), metavar="N", help="Diagnose N again.")
@as_json
def prove(folder: Path | None, at_most: int | None, rediagnose: int, as_json: bool) -> None:
    """Measure how good diagnoses are, on recordings with concealed effects whose keys are known.

    FOLDER is a set that `bayeskin conceal` made; by default the one that is shipped. A recording that has a
    verdict is not diagnosed again, so the command can be interrupted; keys are opened when the verdicts are
    written. With --at-most, what is judged by then is scored. With --rediagnose, N of the recordings are
    diagnosed afresh, elsewhere; the exit code is 1 if one has another verdict than the same sources gave.

    \b
    Example:
      bayeskin prove --rediagnose 2
      bayeskin prove sets/one --at-most 4
    """
    from bayeskin.workflow import proof

    with Terminal() as terminal:
        document = proof.prove(folder, terminal, rediagnose, at_most)
    _answer(document, as_json)


@cli.command(short_help="Make a set of recordings for prove.")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--seed", required=True, type=int, help="What the set is drawn from.")
@click.option("--count", required=True, type=int, help="Recordings in the set.")
@click.option("--only", multiple=True, metavar="NAME", help="`nothing`, a mechanism, an effect outside.")
@as_json
def conceal(folder: Path, seed: int, count: int, only: tuple[str, ...], as_json: bool) -> None:
    """Make a set for `bayeskin prove`: recordings by the full model, with the effects' keys under seal.

    A set has recordings without any effect, with each mechanism, with pairs, and with effects that no
    mechanism is. With --only, which can be repeated, it has what is named, in equal numbers, and sizes from
    one to thirty noise floors: how large must an effect be to be found? A recording that is finished is not
    made again. One takes about half a minute, two are made at once.

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
@click.option("--port", default=4242, show_default=True, type=click.IntRange(0, 65535), help="0: a free one.")
@as_json
def serve(config: Path | None, host: str, port: int, as_json: bool) -> None:
    """Serve the forward model by UM-Bridge, for other tools of uncertainty quantification.

    Serves the model of CONFIG (default: the demo's) on its recording's protocol until Ctrl-C: one input
    vector of the parameters in SI units, one output vector of the mean force [N] in each of the recording's
    bins. A request's config can ask for another protocol, other bins or times, and mechanisms. Only this
    machine can reach it; with --host others can, and nothing asks who they are.

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

    Packages and their versions, the linear solver, threads, disk space, write access; then a short run of the
    full model and a surrogate's prediction against stored numbers, some five seconds (once, after the
    installation, half a minute, because parts are compiled). Exit code 1 if something is broken.

    \b
    Example:
      bayeskin doctor
      bayeskin doctor --json
    """
    from bayeskin.workflow.doctor import examine

    _answer(examine(Path.cwd()), as_json)


def _run(config: Path, last: str | None, scheduler: str | None, as_json: bool) -> None:
    from bayeskin.workflow import stages

    with Terminal() as terminal:
        document = stages.run(config, last, terminal, scheduler=scheduler)
    _answer(document, as_json)


def _answer(document: Mapping[str, Any], as_json: bool) -> None:
    """Prints a command's answer; exits with 1 when it says of itself that it failed."""
    try:
        click.echo(json.dumps(document, indent=2, allow_nan=False) if as_json else document["text"])
        sys.stdout.flush()
    except BrokenPipeError:  # the reader left, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if not document["ok"]:
        raise click.exceptions.Exit(NOT_TRUSTED)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the `bayeskin` command."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a scheduler's end is an interruption too
    sys.exit(exit_code(lambda: cli.main(arguments, prog_name="bayeskin", standalone_mode=False)))
