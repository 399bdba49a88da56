"""What the counters of a GPU say, as Nsight Compute prints it, is read by the names that kernels have here."""

from benchmarks.counters import CACHE, TIME, read_counters

PRINTED = """==PROF== Connected to process 1 (python)
"ID","Kernel Name","Metric Name","Metric Unit","Metric Value"
"0","transfers__locals__p2g_0a1b2c3d_cuda_kernel_forward","gpu__time_duration.sum","ns","1,000"
"0","transfers__locals__p2g_0a1b2c3d_cuda_kernel_forward","lts__t_bytes.sum","byte","2,500"
"1","velocity_kernel__locals__velocity_cuda_kernel_backward","gpu__time_duration.sum","ns","40"
"2","void cub::DeviceRadixSortKernel<int>(T2 *)","gpu__time_duration.sum","ns","7"
"3","transfers__locals__p2g_0a1b2c3d_cuda_kernel_forward","gpu__time_duration.sum","ns","3,000"
"3","transfers__locals__p2g_0a1b2c3d_cuda_kernel_forward","lts__t_bytes.sum","byte","1,500"
==PROF== Disconnected
"""


def test_counters_are_means_over_the_launches_of_a_kernel():
    found = read_counters(PRINTED.splitlines())
    assert list(found) == ["transfers.p2g", "velocity_kernel.velocity backward"]
    assert found["transfers.p2g"].launches == 2
    assert (found["transfers.p2g"].each(TIME), found["transfers.p2g"].each(CACHE)) == (2000.0, 2000.0)
    assert found["velocity_kernel.velocity backward"].each(TIME) == 40.0
