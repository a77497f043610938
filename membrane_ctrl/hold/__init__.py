"""`hold`: start, supervise, take down."""
