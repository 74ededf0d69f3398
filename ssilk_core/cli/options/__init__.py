# SPDX-License-Identifier: Apache-2.0
"""Options that several verbs share, and what they read: one module for each thing that they name."""
