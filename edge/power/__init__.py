"""Electric power: the device's draw, its budget, and the shedding of reasoning to stay below it."""
