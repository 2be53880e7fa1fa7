"""SAPIEN: the scene, grippers, primitives and cameras."""
