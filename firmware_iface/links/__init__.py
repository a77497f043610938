"""Links: how bytes get to a device and back, and what may be believed of them."""
