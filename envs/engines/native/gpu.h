// What modules of kernels for a GPU take.
#pragma once
#include "exact.h"
#include "gathers.h"
#include "lists.h"
#include "walk.h"
