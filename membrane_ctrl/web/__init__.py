"""The lab's window: a page that shows holds and sends commands to them."""
