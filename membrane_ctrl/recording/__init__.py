"""The recorder process: run folder, Rerun streams, blueprint, summary."""
