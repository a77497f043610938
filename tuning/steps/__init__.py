"""The steps of a session: each with its function and its file."""
