"""The steps of a training run in their order: plan, chain of stages, evaluation, model card."""
