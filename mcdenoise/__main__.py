"""`python -m mcdenoise`: the command line, as `torchrun -m mcdenoise` needs it."""

from mcdenoise.cli import main

if __name__ == "__main__":
    main()
