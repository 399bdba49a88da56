// What modules of kernels for a CPU take: theirs, and those of a GPU, which tests run on a CPU.
#pragma once
#include "gpu.h"
#include "grid.h"
#include "materials.h"
#include "sheets.h"
#include "smoothing.h"
