"""Policies and what is asked of them at test time: critics, proposers, methods, baselines, adaptation."""
