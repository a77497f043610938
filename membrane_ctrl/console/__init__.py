"""What a terminal shows of a hold."""
