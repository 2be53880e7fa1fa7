"""Folders of runs, their log, and the processes that work in them: child processes, streams, log lines."""
