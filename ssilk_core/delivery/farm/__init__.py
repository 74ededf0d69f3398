# SPDX-License-Identifier: Apache-2.0
"""Bakes in bulk: jobs as files, job bundles of Open Job Description, workers, and Ray clusters."""
