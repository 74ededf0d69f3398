# SPDX-License-Identifier: Apache-2.0
"""The trade of speed and size for accuracy, measured."""
