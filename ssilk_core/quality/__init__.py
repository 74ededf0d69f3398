# SPDX-License-Identifier: Apache-2.0
"""How good a model is, what it costs, and what to trade: levels, reduction, evaluation, extremes.

In: a model file and held-out motions. Out: figures, smaller models, points on the curve of error over cost.
Open `levels.py` first: it defines the quality levels. `reduction` makes smaller models without training, `cost`
says what playing takes, `evaluation` measures, `stress` tries extremes, and `trade` sweeps over all of it.
Public: `quality.reduction`.
"""
