"""Commands on the folders of sweeps: merge shards, reproduce rows, run the benchmark."""
