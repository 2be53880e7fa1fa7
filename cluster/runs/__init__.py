"""Folders of runs and their logs; child processes, standard streams and logging."""
