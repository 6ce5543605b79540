"""Tests of `demc.torch.light`. `tests/tests/suite/python_live.rs` compares it with `demc-infer`."""

import importlib.util
import unittest

MISSING = importlib.util.find_spec("numpy") is None
if not MISSING:
    import numpy as np
    from demc.torch import light

META = {"normalizer": {"restore_light": True}}


@unittest.skipIf(MISSING, "no numpy")
class Light(unittest.TestCase):
    def setUp(self) -> None:
        self.rng = np.random.default_rng(1)
        self.image = 0.2 + self.rng.random((3, 50, 71))

    def test_missing_light_comes_back_per_colour(self) -> None:
        noisy = self.image * 2 * self.rng.random(self.image.shape)
        denoised = self.image * np.array([0.9, 1.0, 1.08])[:, None, None]
        restored = denoised * light.factors(noisy, denoised, META)
        np.testing.assert_allclose(restored.mean((1, 2)), noisy.mean((1, 2)), rtol=0.01)
        unchanged = light.factors(noisy, denoised, {"normalizer": {}})
        self.assertTrue((unchanged == 1).all())

    def test_equal_images_and_one_bright_sample_have_factors_of_1(self) -> None:
        noisy = self.image.copy()
        noisy[:, 20, 30] = 1e6
        for other in (self.image, noisy):
            self.assertTrue((light.factors(other, self.image, META) == 1).all())

    def test_small_and_black_images_stay_finite(self) -> None:
        for shape in ((3, 1, 1), (3, 3, 9), (3, 40, 2)):
            for noisy in (np.zeros(shape), np.ones(shape)):
                for denoised in (np.zeros(shape), np.ones(shape) * 0.9):
                    found = light.factors(noisy, denoised, META)
                    self.assertEqual(found.shape, shape)
                    self.assertTrue(((found >= 0.64) & (found <= 1.5625)).all())


if __name__ == "__main__":
    unittest.main()
