"""Affordance that adapts to one articulated object after a few tries: the public face."""
