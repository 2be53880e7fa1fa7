"""The networks of the paper, shared by the actors (proposals) and the learner (training)."""
