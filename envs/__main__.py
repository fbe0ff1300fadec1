"""Draw every task: `python -m taic_jax.envs` is `taic envs`."""

import sys

from taic_jax.handles.pictures import main

if __name__ == "__main__":
    sys.exit(main())
