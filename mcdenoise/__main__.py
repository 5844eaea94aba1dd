"""`python -m mcdenoise`: the command line, as `torchrun -m mcdenoise` needs it."""

import sys

# With -m, Python looks for modules in the working folder first, which is that of somebody's frames or scene.
if not sys.flags.safe_path:
    del sys.path[0]

from mcdenoise.cli import main

if __name__ == "__main__":
    main()
