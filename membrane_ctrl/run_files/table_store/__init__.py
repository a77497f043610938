"""Tables of a run: Parquet parts that any program reads, and a journal of the newest rows
(docs/reference/recording.md).
"""
