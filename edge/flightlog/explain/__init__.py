"""Why a robot stopped, collided, went astray or ran out of time, from its flight log; and the video of it."""
