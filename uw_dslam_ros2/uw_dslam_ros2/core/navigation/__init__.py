"""Dead reckoning from DVL, IMU and depth, with covariance."""
