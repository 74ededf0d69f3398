# SPDX-License-Identifier: GPL-3.0-or-later
"""Work in other processes: commands, trainings and their reports. No module here imports `bpy`."""
