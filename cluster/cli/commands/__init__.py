"""The subcommands of `adaafford`, a module each."""
