"""The command line `osf`: one dataclass per command, from which tyro makes the options."""
