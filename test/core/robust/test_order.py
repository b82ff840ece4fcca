# SPDX-License-Identifier: Apache-2.0
"""A judgement hangs neither on the order of factors nor on how often it is asked for."""
