"""Draw one of the paper's figures, or write the table of all kinds of options, or of the gate.

python -m taic_jax.experiments.figures 7
python -m taic_jax.experiments.figures 7 --methods strong long fixed-closed-both-tuned \
    --out experiments/results/returns.png
"""

import sys
from collections.abc import Sequence

import tyro

from taic_jax.command_line import tell
from taic_jax.experiments.figures.figure5 import Figure5ab, Figure5c
from taic_jax.experiments.figures.figure6 import Figure6
from taic_jax.experiments.figures.figure7 import Figure7
from taic_jax.experiments.figures.figure8 import Figure8
from taic_jax.experiments.figures.gate_table import GateTable
from taic_jax.experiments.figures.option_table import OptionTable

PROGRAM = "python -m taic_jax.experiments.figures"
COMMANDS = {kind.number: kind for kind in (Figure5ab, Figure5c, Figure6, Figure7, Figure8)} | {
    "table": OptionTable,
    "gate": GateTable,
}


def main(args: Sequence[str] | None = None) -> int:
    """Make the figure or table of this name from the table of finished runs alone; return the exit code."""
    return tell(lambda: tyro.extras.subcommand_cli_from_dict(COMMANDS, prog=PROGRAM, args=args).make())


if __name__ == "__main__":
    sys.exit(main())
