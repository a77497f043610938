"""The command `tune`: sessions on a running hold or on the twin."""
