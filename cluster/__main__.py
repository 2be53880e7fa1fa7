"""`python -m cluster`: the command line `adaafford`, for whoever starts processes (`torchrun -m cluster train ...`)."""

from adaafford.console import main

if __name__ == "__main__":
    main()
