"""`python -m thermocald` is the command `thermocald`."""

from thermocald.cli import main

if __name__ == "__main__":
    main()
