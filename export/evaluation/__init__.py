"""How exact a rounded model is: references, metrics, the task error, the gate, and the choice of precision."""
