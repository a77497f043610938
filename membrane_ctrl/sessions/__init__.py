"""What tuning and calibration sessions share: folder, link to a hold, progress."""
