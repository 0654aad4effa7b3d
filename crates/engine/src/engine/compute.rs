//! Which device computes, and in which precision; chosen at run time.

use burn::tensor::Device;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::EngineError;

/// Where tensors live.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeviceChoice {
    /// This machine's processor.
    #[default]
    Cpu,
    /// An NVIDIA GPU (builds with feature `cuda`).
    Cuda,
    /// Any GPU with a Vulkan driver (builds with feature `vulkan`).
    Vulkan,
}

/// In which numbers matrix products are computed: f32 for now, on every device. Norms, softmax, losses, codebooks and weights are
/// always f32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// Single precision, 32 bits.
    #[default]
    F32,
    /// bfloat16: not available, no operation computes in it yet.
    Bf16,
}

/// A device that computes in f32.
#[derive(Debug, Clone)]
pub struct Compute {
    device: Device,
}

impl Compute {
    /// The processor in f32: always available, and deterministic.
    #[must_use]
    pub fn cpu() -> Self {
        Self {
            device: Device::flex(),
        }
    }

    /// The device `choice` (`index` counts the devices of one kind), computing in `precision`.
    ///
    /// # Errors
    /// When this build or this machine has no such device, or no operation computes in `precision`.
    pub fn new(
        choice: DeviceChoice,
        index: usize,
        precision: Precision,
    ) -> Result<Self, EngineError> {
        let device = match choice {
            DeviceChoice::Cpu => Device::flex(),
            DeviceChoice::Cuda => cuda(index)?,
            DeviceChoice::Vulkan => vulkan(index)?,
        };
        if precision == Precision::Bf16 {
            return Err(EngineError::Precision {
                precision: "bf16",
                device: match choice {
                    DeviceChoice::Cpu => "cpu".to_owned(),
                    DeviceChoice::Cuda => format!("cuda:{index}"),
                    DeviceChoice::Vulkan => format!("vulkan:{index}"),
                },
            });
        }
        Ok(Self { device })
    }

    /// The tensor library's handle.
    #[must_use]
    pub fn device(&self) -> &Device {
        &self.device
    }
}

#[cfg(feature = "cuda")]
fn cuda(index: usize) -> Result<Device, EngineError> {
    use burn::tensor::DeviceType;
    let mut found = Device::enumerate(DeviceType::Cuda).into_iter();
    found.nth(index).ok_or_else(|| EngineError::NoSuchDevice {
        device: format!("cuda:{index}"),
        hint: "this machine has no such NVIDIA GPU, or no driver for it; `device: cpu` always works",
    })
}

#[cfg(not(feature = "cuda"))]
fn cuda(index: usize) -> Result<Device, EngineError> {
    Err(EngineError::NoSuchDevice {
        device: format!("cuda:{index}"),
        hint: "this program was built without NVIDIA GPUs; build with `--features cuda`",
    })
}

/// Discrete GPUs come first. Programs that play a GPU on the processor do not count.
#[cfg(feature = "vulkan")]
fn vulkan(index: usize) -> Result<Device, EngineError> {
    use burn::tensor::{DeviceKind, DeviceType};
    let software = Device::vulkan(DeviceKind::Cpu);
    let mut found = Device::enumerate(DeviceType::Vulkan)
        .into_iter()
        .filter(|device| *device != software);
    found.nth(index).ok_or_else(|| EngineError::NoSuchDevice {
        device: format!("vulkan:{index}"),
        hint: "this machine has no such GPU with a Vulkan driver; `device: cpu` always works",
    })
}

#[cfg(not(feature = "vulkan"))]
fn vulkan(index: usize) -> Result<Device, EngineError> {
    Err(EngineError::NoSuchDevice {
        device: format!("vulkan:{index}"),
        hint: "this program was built without Vulkan; build with `--features vulkan`",
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bf16_is_refused_by_name_with_the_device() {
        let error = Compute::new(DeviceChoice::Cpu, 0, Precision::Bf16).unwrap_err();
        let message = error.to_string();
        assert!(
            message.contains("`bf16`") && message.contains("`cpu`"),
            "{message}"
        );
    }

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn a_missing_device_says_how_to_get_it() {
        let error = Compute::new(DeviceChoice::Cuda, 1, Precision::F32).unwrap_err();
        assert!(error.to_string().contains("--features cuda"), "{error}");
    }

    #[cfg(any(feature = "cuda", feature = "vulkan"))]
    #[test]
    fn a_gpu_that_the_machine_lacks_is_refused_before_anything_is_computed() {
        let choices = [
            #[cfg(feature = "cuda")]
            DeviceChoice::Cuda,
            #[cfg(feature = "vulkan")]
            DeviceChoice::Vulkan,
        ];
        for choice in choices {
            let error = Compute::new(choice, 99, Precision::F32).unwrap_err();
            assert!(error.to_string().contains("no such"), "{error}");
        }
    }
}
