"""Memory that grows: each part of the runner alone at many times its rate, or the whole stack in real time."""
