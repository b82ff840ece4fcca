// SPDX-License-Identifier: Apache-2.0
#define NAME _portable
#include "module.hpp"
