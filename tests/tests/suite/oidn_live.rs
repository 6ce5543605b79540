//! Weights of an installed Open Image Denoise: imported, denoised with, exported, and run by it. Skipped
//! without `pyoidn`; `DEMC_REQUIRE_OIDN=1` makes that a failure.

use std::path::PathBuf;

use burn::tensor::Device;
use demc_infer::tza::weight_sets;
use demc_infer::verify::{Runtime, verify};
use demc_infer::{Bundle, Precision};

use crate::live::Python;

const LIBRARY: &str = "import pathlib, pyoidn
folder = pathlib.Path(pyoidn.__file__).parent / 'oidn' / 'lib'
print(next(path for path in folder.iterdir() if 'OpenImageDenoise_core' in path.name))";

/// The library with the weights in the installed package.
fn library(python: &Python) -> PathBuf {
    let run = python.run(["-c", LIBRARY]).expect("it ran before");
    PathBuf::from(String::from_utf8(run.stdout).expect("a path").trim())
}

#[test]
fn imported_weights_denoise_as_open_image_denoise_does() {
    let Some(python) = Python::with("numpy, pyoidn", "numpy pyoidn", "DEMC_REQUIRE_OIDN") else {
        return;
    };
    let library = library(&python);
    let device = Device::flex();
    let sets = weight_sets(&library).expect("a library of Open Image Denoise");
    let names: Vec<String> = sets
        .iter()
        .filter(|set| set.is_hdr())
        .map(|set| set.name.clone().expect("the library has names"))
        .collect();
    assert!(
        names.iter().any(|name| name == "rt_hdr_alb_nrm"),
        "{names:?}"
    );
    let folder = tempfile::TempDir::new().expect("a temporary directory");
    for name in names {
        let bundle = Bundle::import_oidn(&library, Some(&name), &device).expect("imported");
        for precision in [Precision::F32, Precision::F16] {
            let path = folder.path().join(format!("{name}.tza"));
            bundle.export_tza(&path, precision).expect("exported");
            let found = verify(&path, Runtime::Oidn, python.path(), &bundle).expect("it runs");
            for deviation in &found.deviations {
                println!("{name}, {precision:?}: {deviation:?}");
                assert!(deviation.passes(), "{name}: {deviation:?}");
            }
        }
    }
}
