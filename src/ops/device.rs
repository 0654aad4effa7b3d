//! Where a stage computes.

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
