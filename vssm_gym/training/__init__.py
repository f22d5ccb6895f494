"""Train policies in a learned map or in the simulator, and evaluate them.

``config`` defines a training, ``train`` runs it, in a ``run`` with its clock and log: by reinforcement learning
(``sb3``) in an ``environment``, or by ``cloning``. ``evaluation`` compares a policy in the simulator with its
``imagined_episodes``; ``recording`` and ``video`` show both, ``learning_curves`` draws how fast trainings learn.
"""
