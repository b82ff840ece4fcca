// SPDX-License-Identifier: Apache-2.0
#define NAME _avx2
#include "module.hpp"
