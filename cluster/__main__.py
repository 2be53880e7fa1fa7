"""`python -m cluster`: the command line `adaafford`, for launchers (`torchrun -m cluster train ...`)."""

from adaafford.console import main

if __name__ == "__main__":
    main()
