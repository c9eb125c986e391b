"""The commands of `osf`: one frozen dataclass each, from which the command line is generated."""
