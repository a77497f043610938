"""What is shown on the screen and what is learnt of it, as pure functions of images and numbers."""
