"""Settings of a run, from defaults, presets, files and flags."""
