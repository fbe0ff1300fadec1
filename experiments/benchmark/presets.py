"""Minutes of one seed of every preset here, by the first steps of each stage: the table of `taic presets`.

python -m taic_jax.experiments.benchmark.presets > experiments/results/presets.csv
"""

import tempfile
from pathlib import Path

from taic_jax.config.files import load_config, preset_names
from taic_jax.handles.calibration import calibrate
from taic_jax.runtime.program_cache import keep_programs


def main() -> None:
    """Print CSV, a preset per line; a transfer takes the options that ship with the package."""
    keep_programs()
    print("preset,minutes")
    for name in preset_names():
        with tempfile.TemporaryDirectory() as folder:
            print(f"{name},{calibrate(load_config(name), Path(folder) / name).seconds / 60:.2g}", flush=True)


if __name__ == "__main__":
    main()
