// Kernels of a CPU one after another, without Python in between.
#pragma once
#include "builtin.h"

namespace gradscape {

// A call is four addresses: of a kernel's function, of its dimensions, of its arguments, and of their adjoints or none.
inline void run_calls(int, const wp::array_t<wp::uint64>& calls) {
    const auto at = [](wp::uint64 address) { return (void*)address; };
    for (const wp::uint64 *c = calls.data, *end = c + calls.shape[0]; c < end; c += 4)
        if (c[3])
            ((void (*)(void*, void*, void*))c[0])(at(c[1]), at(c[2]), at(c[3]));
        else
            ((void (*)(void*, void*))c[0])(at(c[1]), at(c[2]));
}

}  // namespace gradscape
