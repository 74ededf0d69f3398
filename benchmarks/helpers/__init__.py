# SPDX-License-Identifier: Apache-2.0
"""Modules that the scripts of this folder share."""
