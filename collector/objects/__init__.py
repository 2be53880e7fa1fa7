"""Articulated objects: reading folders, meshes and URDF, decomposition, and procedural ones."""
