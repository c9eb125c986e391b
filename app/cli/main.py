"""The command line `osf`: one dataclass per command, each in `app/cli/commands/`."""

from __future__ import annotations

import json
import os
import sys
from importlib.metadata import version
from typing import Annotated, Any, Protocol

import tyro

from app.cli.commands.assets import Assets
from app.cli.commands.backup import Backup, Restore
from app.cli.commands.bench import Bench
from app.cli.commands.check import Check
from app.cli.commands.collect import Collect
from app.cli.commands.episode import RunEpisode
from app.cli.commands.estimate import Estimate
from app.cli.commands.evaluate import Evaluate
from app.cli.commands.evaluations.reproduce import ReproduceCommand
from app.cli.commands.exchange.export import Export
from app.cli.commands.exchange.import_scene import Import
from app.cli.commands.photo import Photo
from app.cli.commands.predict import Predict
from app.cli.commands.recordings.clip import Clip
from app.cli.commands.recordings.lerobot import LeRobot
from app.cli.commands.recordings.mcap import Mcap
from app.cli.commands.recordings.record import Record
from app.cli.commands.render import Render
from app.cli.commands.robots.robot import RobotCommand
from app.cli.commands.serve import Serve
from app.cli.commands.train import Train
from osfcore.errors import OsfError
from osfcore.extras import told_of


class Command(Protocol):
    """What every command offers."""

    @property
    def json(self) -> bool:
        """Whether the result is printed as JSON."""
        ...

    def run(self) -> dict[str, Any]:
        """Do it; return what `--json` prints."""
        ...


Commands = Annotated[
    Annotated[Serve, tyro.conf.subcommand("serve", description="Start the service and its page.")]
    | Annotated[Assets, tyro.conf.subcommand("assets", description="List, fetch and add objects.")]
    | Annotated[Collect, tyro.conf.subcommand("collect", description="Collect image sets, pushes and observations.")]
    | Annotated[Train, tyro.conf.subcommand("train", description="Train fields from images, dynamics from pushes.")]
    | Annotated[Render, tyro.conf.subcommand("render", description="Render a scene through its fields.")]
    | Annotated[Estimate, tyro.conf.subcommand("estimate", description="Find poses and light in images.")]
    | Annotated[Photo, tyro.conf.subcommand("photo", description="Find objects and lamp in a photograph.")]
    | Annotated[Predict, tyro.conf.subcommand("predict", description="Predict what pushes would do.")]
    | Annotated[RunEpisode, tyro.conf.subcommand("episode", description="Push until the table looks like a photo.")]
    | Annotated[RobotCommand, tyro.conf.subcommand("robot", description="Look at a robot, and drive it.")]
    | Annotated[Clip, tyro.conf.subcommand("clip", description="Make a clip of an episode.")]
    | Annotated[Mcap, tyro.conf.subcommand("mcap", description="Write an episode for Foxglove.")]
    | Annotated[LeRobot, tyro.conf.subcommand("lerobot", description="Write episodes as a LeRobot data set.")]
    | Annotated[Record, tyro.conf.subcommand("record", description="Make the stories that the page plays.")]
    | Annotated[Evaluate, tyro.conf.subcommand("eval", description="Measure how good trained parts are.")]
    | Annotated[
        ReproduceCommand, tyro.conf.subcommand("reproduce", description="The paper's experiments in one report.")
    ]
    | Annotated[Bench, tyro.conf.subcommand("bench", description="Measure what things cost on this machine.")]
    | Annotated[Export, tyro.conf.subcommand("export", description="Scenes, fields and poses for other programs.")]
    | Annotated[Import, tyro.conf.subcommand("import", description="Data sets of others for 'osf estimate'.")]
    | Annotated[Backup, tyro.conf.subcommand("backup", description="Write all that the service keeps to one zip.")]
    | Annotated[Restore, tyro.conf.subcommand("restore", description="Make a data directory from a backup.")]
    | Annotated[Check, tyro.conf.subcommand("check", description="Check a file or folder of any kind.")],
    tyro.conf.OmitSubcommandPrefixes,
]


def main(arguments: list[str] | None = None) -> int:
    """Run one command; 0 on success, 1 if it could not be done, 2 for a wrong call, 130 when interrupted."""
    # Threads spin while they wait for each other; for long, that stalls a machine that has anything else to do.
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    if (sys.argv[1:] if arguments is None else arguments) == ["--version"]:
        print(f"osf {version('osf-manipulation')}")
        return 0
    description = "Rearrange real objects from a photo. 'osf --version' prints the version."
    try:
        command: Command = tyro.cli(Commands, prog="osf", args=arguments, description=description)
        result = command.run()
    except OsfError as error:
        print(f"osf: {error}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        told = told_of(error, "This command")
        if told is None:
            raise
        print(f"osf: {told}", file=sys.stderr)
        return 1
    except BrokenPipeError:  # whoever read our output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        print(f"osf: {error.strerror or error}{f': {error.filename}' if error.filename else ''}.", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("osf: interrupted", file=sys.stderr)
        return 130
    if command.json:
        print(json.dumps(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
