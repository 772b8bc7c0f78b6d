"""Config-driven calibration studies built on `sfm_calib`."""
