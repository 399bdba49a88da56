// What modules of kernels for a CPU take: theirs, and those of a GPU, which tests run on a CPU.
#pragma once
#include "calls.h"
#include "contact.h"
#include "gpu.h"
#include "grid.h"
#include "materials.h"
#include "smoothing.h"
