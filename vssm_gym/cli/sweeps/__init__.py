"""Commands on the folders of sweeps: merge shards, reproduce rows."""
