"""The project that every attack starts from works."""
from common import Attack


class Setup(Attack):
    def test_00_the_project_denoises(self):
        result = self.run_program("demc-infer", "denoise", "frame.exr", "-o", "out.exr", "--model", "model.safetensors")
        self.assertEqual(result.code, 0, result)
        self.assertTrue((self.root / "out.exr").is_file())
