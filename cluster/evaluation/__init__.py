"""Evaluation of policies: trials, tables, and the figures of the paper beside them."""
