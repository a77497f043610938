"""What crosses between processes: shared-memory rings and frames that a slow or dead reader cannot block."""
