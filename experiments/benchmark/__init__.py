"""The benchmark: ticks per second beside the bare engine and other libraries, and what the parts cost."""
