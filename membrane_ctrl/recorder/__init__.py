"""The recorder process: Rerun segments and exact tables."""
