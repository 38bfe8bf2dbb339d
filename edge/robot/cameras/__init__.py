"""Camera pictures that do not come over the robot's protocol: MJPEG over HTTP, V4L2 devices, GStreamer pipelines."""
