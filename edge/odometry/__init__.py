"""Odometry: body odometry, gyro and camera motion fused into one planar pose with its uncertainty."""
