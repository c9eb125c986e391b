"""The command line `osf`: finds the command, reads its options, runs it, and turns what went wrong into a sentence."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .command import Command

# For each command the class, or union of classes, in app/cli and a description. Modules may take more than a second, so
# that only the command's own is imported.
COMMANDS = {
    "demo": ("demo:Demo", "Fetch objects, start the service, open its page."),
    "serve": ("serve:Serve", "Start the service and its page."),
    "assets": ("assets:Assets", "List, fetch and add objects."),
    "collect": ("collect:Collect", "Collect image sets, pushes and observations."),
    "train": ("train:Train", "Train fields from images, dynamics from pushes."),
    "render": ("estimate:Render", "Render a scene through its fields."),
    "estimate": ("estimate:Estimate", "Find poses and light in images."),
    "photo": ("photo:Photo", "Find objects and lamp in a photograph."),
    "predict": ("estimate:Predict", "Predict what pushes would do."),
    "episode": ("episode:RunEpisode", "Push until the table looks like a photo."),
    "robot": ("robot:RobotCommand", "Look at a robot, and drive it."),
    "clip": ("episode:Clip", "Make a clip of an episode."),
    "mcap": ("episode:Mcap", "Write an episode for Foxglove."),
    "lerobot": ("episode:LeRobot", "Write episodes as a LeRobot data set."),
    "record": ("episode:Record", "Make the stories that the page plays."),
    "eval": ("evaluate:Evaluate", "Measure how good trained parts are."),
    "reproduce": ("evaluate:ReproduceCommand", "The paper's figures 5, 6 and 7, and more, in one report."),
    "bench": ("bench:Bench", "Measure what things cost on this machine."),
    "export": ("exchange:Export", "Scenes, fields and poses for other programs."),
    "import": ("exchange:Import", "Data sets of others for 'osf estimate'."),
    "mcp": ("mcp:Mcp", "Offer a service to an assistant (MCP)."),
    "backup": ("serve:Backup", "Write all that the service keeps to one zip."),
    "restore": ("serve:Restore", "Make a data directory from a backup."),
    "check": ("exchange:Check", "Check a file or folder of any kind."),
}


def main(arguments: list[str] | None = None) -> int:
    """Run one command; 0 on success, 1 if it could not be done, 2 for a wrong call, 130 when interrupted."""
    arguments = sys.argv[1:] if arguments is None else arguments
    # Threads spin while they wait for each other; for long, that stalls a machine that has anything else to do.
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    try:
        try:
            return _run(arguments)
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()  # a full disk is noticed here, and not while the interpreter ends
    except KeyboardInterrupt:
        return _refuse("interrupted", 130)
    except BrokenPipeError:  # whoever read our output has gone
        _drop_output()
        return 1
    except OSError as error:
        _drop_output()
        return _refuse(f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}.", 1)
    except (ValueError, ModuleNotFoundError) as error:
        return _explained(error)


def _run(arguments: list[str]) -> int:
    if arguments == ["--version"]:
        from importlib.metadata import version

        print(f"osf {version('osf-manipulation')}")
        return 0
    command = _parsed(arguments)
    data_dir = getattr(command, "data_dir", None)
    if data_dir is not None:  # what is made once is kept there, by child processes, too
        os.environ["NUMBA_CACHE_DIR"] = os.environ.get("NUMBA_CACHE_DIR") or str(data_dir.absolute() / "compiled")
        if not os.access(os.path.expanduser("~"), os.W_OK):  # cma loads Matplotlib, which keeps its list of fonts
            os.environ.setdefault("MPLCONFIGDIR", str(data_dir.absolute() / "matplotlib"))
    result = command.run()
    if command.json:
        import json

        print(json.dumps(result))
    return 0


def _parsed(arguments: list[str]) -> Command:
    from dataclasses import make_dataclass
    from importlib import import_module
    from typing import Annotated, Union

    import tyro

    if os.environ.get("NO_COLOR"):
        tyro._experimental_options["ansi_codes"] = False
    if arguments and arguments[0] in COMMANDS:
        place, description = COMMANDS[arguments[0]]
        module, _, name = place.partition(":")
        kind = getattr(import_module(f".{module}", __package__), name)
        return tyro.cli(kind, prog=f"osf {arguments[0]}", args=arguments[1:], description=description)
    kinds = [
        Annotated[make_dataclass(name, ()), tyro.conf.subcommand(name, description=description)]
        for name, (_, description) in COMMANDS.items()
    ]
    description = "Rearrange real objects from a photo. 'osf --version' prints the version."
    choice: Any = Union[tuple(kinds)]  # noqa: UP007
    tyro.cli(choice, prog="osf", args=arguments, description=description)
    raise AssertionError("the command line lists its commands or refuses the call")


def _explained(error: ValueError | ModuleNotFoundError) -> int:
    """Print what was wrong with the call (2), or what failed (1); raise anew what is no error of ours."""
    from osfcore.errors import InvalidInput, OsfError, UnknownName
    from osfcore.extras import as_missing_extra

    explained = as_missing_extra(error, "This command") if isinstance(error, ModuleNotFoundError) else error
    if not isinstance(explained, OsfError):
        raise error
    return _refuse(str(explained), 2 if isinstance(explained, InvalidInput | UnknownName) else 1)


def _refuse(sentence: str, code: int) -> int:
    import contextlib

    with contextlib.suppress(OSError):  # standard error may be what is full, or gone
        print(f"osf: {sentence}", file=sys.stderr)
    return code


def _drop_output() -> None:
    """Let go of standard output if it cannot be written, so that the interpreter does not try again as it ends."""
    if sys.stdout is None:
        return
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main())
