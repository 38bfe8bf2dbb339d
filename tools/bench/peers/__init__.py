"""Other people's runtimes on our shapes and weights; they live in an environment of their own (`install.sh`)."""
