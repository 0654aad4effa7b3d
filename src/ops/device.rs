//! Where a stage computes.

use crate::engine::communicator::reduce::Reduction;
use crate::engine::compute::OutOfMemory;
use crate::engine::{Communicator, Compute, DeviceChoice, DeviceKind, Precision};
use crate::experiment::{Code, StageContext, StageError};

/// The device that a stage's settings name, or of several ranks on one machine as many devices on; says which one, where it is not
/// the processor.
pub(super) fn compute(
    choice: DeviceChoice,
    precision: Precision,
    context: &mut dyn StageContext,
) -> Result<Compute, StageError> {
    let choice = match choice.kind {
        DeviceKind::Cpu | DeviceKind::Auto => choice,
        kind => DeviceChoice {
            kind,
            index: choice.index + Communicator::world().local_rank(),
        },
    };
    let compute = Compute::new(choice, precision).map_err(|error| StageError::Input {
        code: Code::E0601,
        message: error.to_string(),
        help: format!(
            "change it with `--set stages.{}.device=cpu`",
            context.stage()
        ),
    })?;
    if choice != DeviceChoice::CPU {
        context.log(&format!("computes on {}", compute.name()));
    }
    Ok(compute)
}

/// The ranks of a training on this device, all of which must be here; says how gradients travel between GPUs.
pub(super) fn ranks(
    compute: &Compute,
    reduction: Reduction,
    context: &mut dyn StageContext,
) -> Result<Communicator, StageError> {
    let ranks = Communicator::world().on(compute, reduction);
    let (ranks, how) = ranks.map_err(StageError::other)?;
    if let Some(how) = how {
        context.log(&how);
    }
    Ok(ranks)
}

/// What a panic of the tensor library with this text says, where it says that a device's memory is full; `lower` is what to lower.
pub(super) fn memory_is_full(text: &str, lower: &str) -> Option<StageError> {
    let full = OutOfMemory::said(text)?;
    let asked = full.bytes.map_or_else(String::new, |bytes| {
        format!(" for an array of {:.2} GB more", bytes as f64 / 1e9)
    });
    Some(StageError::Input {
        code: Code::E0501,
        message: format!("the device has no memory left{asked}"),
        help: lower.to_owned(),
    })
}

/// What to lower where a model only computes forward.
pub(super) const SMALLER_FORWARD: &str =
    "end what else runs on the device, take one with more memory, or `device: cpu`";

/// What to lower where one is trained.
pub(super) const SMALLER_MICRO_BATCH: &str =
    "lower `micro_batch`: gradients are accumulated, and `batch` stays";

#[cfg(test)]
mod tests {
    use super::*;

    /// As the library says it, with what an `unwrap` writes before it and a backtrace behind.
    #[test]
    fn a_full_device_is_one_sentence_with_the_way_out_and_other_panics_stay_bugs() {
        let full = "called `Result::unwrap()` on an `Err` value: out of device memory allocating 2500000000 bytes\n   0: cubecl";
        match memory_is_full(full, "lower `micro_batch`") {
            Some(StageError::Input {
                code,
                message,
                help,
            }) => {
                assert_eq!(code, Code::E0501);
                assert_eq!(
                    message,
                    "the device has no memory left for an array of 2.50 GB more"
                );
                assert_eq!(help, "lower `micro_batch`");
            }
            other => panic!("{other:?}"),
        }
        assert!(memory_is_full("index out of bounds: the len is 3", "").is_none());
    }
}
