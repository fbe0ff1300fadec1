"""The benchmark: ticks per second beside the bare engine and other libraries, and the costs of the parts."""
