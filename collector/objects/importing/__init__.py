"""Objects of other layouts, turned into folders of this project's own: URDF, MJCF, GAPartNet, Articulate-Anything."""
