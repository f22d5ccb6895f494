"""Run the package from a terminal: ``vssm-gym COMMAND``, one file for each command."""
