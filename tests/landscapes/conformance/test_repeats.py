"""What repeats may differ by, and what a check says where memory runs out."""

import torch

from gradscape.landscapes.conformance.suite import check

from .test_suite import Sound, failures, outcomes


class UnsteadyGradient(Sound):
    """Repeats of it differ by a share of its gradients."""

    def __init__(self, share=1e-4):
        self.generator, self.share = torch.Generator().manual_seed(0), share

    def slope(self, slope):
        return slope * (1 + self.share * torch.randn(slope.shape, generator=self.generator))


def test_gradients_that_do_not_repeat_fail():
    assert failures(UnsteadyGradient()) == {"determinism"}


def test_gradients_may_repeat_less_exactly_than_losses():
    found = outcomes(UnsteadyGradient(1e-7))["determinism"]
    assert found.outcome == "pass"
    assert found.numbers["limit"] < found.numbers["gradient"] < found.numbers["gradient_limit"]


def test_memory_that_runs_out_is_said_with_what_to_do():
    class Large(Sound):
        def evaluate(self, x, *, grad=True):
            if len(x) > 4:
                raise RuntimeError("Failed to allocate 123456 bytes on device 'cuda:0'")
            return super().evaluate(x, grad=grad)

    found = [finding for finding in check(Large()) if finding.bad]
    assert found
    assert all("end what else uses the device" in finding.why for finding in found)
