"""``python -m sb3_uspl.experiments``: the paper's tables and figures, from trainings that can be interrupted at any time.

``zoo_configs/experiments.yml`` says what there is; ``plan`` turns it into cells (variant x environment x seed); ``runner`` has
the cells trained and measured by child processes; ``results`` reads what they measured; ``tables`` and ``figures`` show it.
"""
