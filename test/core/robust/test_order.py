# SPDX-License-Identifier: Apache-2.0
"""A judgement hangs neither on the order in which factors came nor on how often it is asked for."""
