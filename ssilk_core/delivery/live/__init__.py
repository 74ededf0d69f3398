# SPDX-License-Identifier: Apache-2.0
"""A solver that follows what is played: poses come in through a pipe, and frames go out as they are solved.

Open `messages.py` first: what is said, and in which bytes. It needs numpy alone, and programs without PyTorch import
it. `service.py` is what 'ssilk live' runs.
"""
