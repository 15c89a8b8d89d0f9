"""The command line `gmem`: options become an experiment, results become tables, files and exit codes."""
