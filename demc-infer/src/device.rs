//! Turns device names into Burn devices: `flex`, `ndarray`, `wgpu[:N]`, `cuda[:N]`.
//!
//! The user always names the device. Burn's default would depend on the compiled features and on
//! the variable `BURN_DEVICE`. `flex` (Burn's CPU backend) is in every build; the others are cargo
//! features of the same name.
//!
//! Burn's constructors are lazy, and a missing GPU panics at the first tensor, on a thread of the
//! runtime. So [`parse`] first lists the runtime's devices, which does not panic without a driver.
//! Then it computes one sum on the chosen device, with panics caught and their output silenced.
//! Only a computation shows a driver without its compiler (CUDA without NVRTC).

use burn::tensor::Device;

/// The device names that [`parse`] accepts, as shown to users.
pub const KNOWN: &str = "flex, ndarray, wgpu[:N], cuda[:N]";

/// Why a device cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum DeviceError {
    /// The name is unknown.
    #[error("unknown device `{name}`; known devices: {KNOWN}")]
    Unknown { name: String },
    /// The backend exists, but is not in this build.
    #[error("device `{name}`: not in this build; build with `--features {feature}`")]
    NotBuilt { name: String, feature: &'static str },
    /// The runtime lists no such device on this machine.
    #[error("device `{name}`: not on this machine, which has {found} such device(s); {hint}")]
    Absent {
        name: String,
        /// Number of devices of this backend.
        found: usize,
        hint: &'static str,
    },
    /// The device is listed, but a test computation on it failed.
    #[error("device `{name}`: a test computation failed: {reason}")]
    Broken { name: String, reason: String },
}

/// The device called `name`: `flex`, `ndarray`, `wgpu`, `wgpu:N`, `cuda` or `cuda:N`.
///
/// `wgpu` without a number is the runtime's preferred adapter: a discrete GPU before an integrated
/// one, and both before software. `wgpu:N` is the N-th listed adapter, from 0. The device has no
/// autodiff; training adds it.
///
/// # Errors
/// Every [`DeviceError`]. Nothing is printed and nothing panics.
///
/// ```
/// use demc_infer::device;
/// assert!(device::parse("flex").is_ok());
/// assert!(device::parse("tpu").unwrap_err().to_string().contains("known devices: flex"));
/// ```
pub fn parse(name: &str) -> Result<Device, DeviceError> {
    let unknown = || DeviceError::Unknown { name: name.into() };
    let (backend, index) = match name.split_once(':') {
        Some((backend, index)) => (backend, Some(index.parse().map_err(|_| unknown())?)),
        None => (name, None),
    };
    match (backend, index) {
        ("flex", None) => Ok(Device::flex()),
        ("ndarray", None) => ndarray(name),
        ("wgpu", index) => wgpu(name, index),
        ("cuda", index) => cuda(name, index),
        _ => Err(unknown()),
    }
}

#[cfg(feature = "ndarray")]
#[expect(
    deprecated,
    reason = "deprecated upstream in favour of flex; offered while 0.22 has it"
)]
fn ndarray(_name: &str) -> Result<Device, DeviceError> {
    Ok(Device::ndarray())
}

#[cfg(not(feature = "ndarray"))]
fn ndarray(name: &str) -> Result<Device, DeviceError> {
    Err(not_built(name, "ndarray"))
}

#[cfg(feature = "wgpu")]
fn wgpu(name: &str, index: Option<usize>) -> Result<Device, DeviceError> {
    use burn::tensor::{DeviceKind, DeviceType};
    let mut listed = Device::enumerate(DeviceType::Wgpu).into_vec();
    if index.is_none() && !listed.is_empty() {
        listed = vec![Device::wgpu(DeviceKind::DefaultDevice)];
    }
    let hint = "wgpu needs a graphics driver with Vulkan (without a GPU: mesa-vulkan-drivers)";
    pick(name, listed, index.unwrap_or(0), hint)
}

#[cfg(not(feature = "wgpu"))]
fn wgpu(name: &str, _index: Option<usize>) -> Result<Device, DeviceError> {
    Err(not_built(name, "wgpu"))
}

#[cfg(feature = "cuda")]
fn cuda(name: &str, index: Option<usize>) -> Result<Device, DeviceError> {
    let listed = Device::enumerate(burn::tensor::DeviceType::Cuda).into_vec();
    let hint = "cuda needs an NVIDIA GPU with its driver and the CUDA toolkit's NVRTC";
    pick(name, listed, index.unwrap_or(0), hint)
}

#[cfg(not(feature = "cuda"))]
fn cuda(name: &str, _index: Option<usize>) -> Result<Device, DeviceError> {
    Err(not_built(name, "cuda"))
}

#[cfg(not(all(feature = "ndarray", feature = "wgpu", feature = "cuda")))]
fn not_built(name: &str, feature: &'static str) -> DeviceError {
    DeviceError::NotBuilt {
        name: name.into(),
        feature,
    }
}

/// Device `index` of `listed`, after a test computation.
#[cfg(any(feature = "wgpu", feature = "cuda"))]
fn pick(
    name: &str,
    listed: Vec<Device>,
    index: usize,
    hint: &'static str,
) -> Result<Device, DeviceError> {
    let found = listed.len();
    let device = listed.into_iter().nth(index).ok_or(DeviceError::Absent {
        name: name.into(),
        found,
        hint,
    })?;
    match probe(&device) {
        Ok(()) => Ok(device),
        Err(reason) => Err(DeviceError::Broken {
            name: name.into(),
            reason: reason.lines().next().unwrap_or("no reason given").into(),
        }),
    }
}

/// Computes 1 + 1 on `device`. A panic becomes an error with the first panic's message, which is
/// that of the runtime's thread.
#[cfg(any(feature = "wgpu", feature = "cuda"))]
fn probe(device: &Device) -> Result<(), String> {
    use burn::tensor::Tensor;
    use std::panic::{AssertUnwindSafe, catch_unwind, set_hook, take_hook};
    use std::sync::{Arc, OnceLock};
    let sum = || {
        let one = Tensor::<1>::ones([1], device);
        (one.clone() + one).try_into_vec_as::<f32>()
    };
    let message = Arc::new(OnceLock::new());
    let first = Arc::clone(&message);
    let hook = take_hook();
    set_hook(Box::new(move |panic| {
        first.get_or_init(|| panic.payload_as_str().unwrap_or("panic").to_string());
    }));
    let outcome = catch_unwind(AssertUnwindSafe(sum));
    set_hook(hook);
    match outcome {
        Ok(Ok(sum)) if sum == [2.0] => Ok(()),
        Ok(Ok(sum)) => Err(format!("1 + 1 gave {sum:?}")),
        Ok(Err(error)) => Err(error.to_string()),
        Err(_) => Err(message.get().cloned().unwrap_or_default()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flex_is_in_every_build() {
        assert_eq!(parse("flex").expect("flex"), Device::flex());
    }

    #[test]
    fn unknown_names_list_the_known_ones() {
        for name in [
            "gpu",
            "",
            "flex:0",
            "ndarray:1",
            "cuda:",
            "cuda:x",
            "wgpu:-1",
            "CUDA",
        ] {
            let error = parse(name).expect_err(name);
            assert_eq!(error, DeviceError::Unknown { name: name.into() });
            assert!(
                error
                    .to_string()
                    .ends_with("flex, ndarray, wgpu[:N], cuda[:N]")
            );
        }
    }

    #[cfg(not(feature = "wgpu"))]
    #[test]
    fn a_backend_not_built_names_its_feature() {
        let error = parse("wgpu:1").expect_err("not built").to_string();
        assert_eq!(
            error,
            "device `wgpu:1`: not in this build; build with `--features wgpu`"
        );
    }

    #[cfg(any(feature = "wgpu", feature = "cuda"))]
    #[test]
    fn a_missing_device_is_an_error() {
        for name in ["wgpu:4000", "cuda:4000"] {
            let error = parse(name).expect_err(name);
            assert!(
                matches!(
                    error,
                    DeviceError::Absent { .. } | DeviceError::NotBuilt { .. }
                ),
                "{error}"
            );
        }
    }
}
