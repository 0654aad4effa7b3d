//! `reviv plan --devices 256`: what the trainings of an experiment take on many devices.

use super::terminal::Failure;
use crate::experiment::Experiment;
use crate::experiment::plan::PlannedStage;
use crate::experiment::scaling::{Cluster, Cost, INTERCONNECTS, Interconnect, Training};
use std::fmt::Write as _;

/// The cluster that trainings are planned for
#[derive(Debug, clap::Args)]
#[expect(clippy::struct_field_names, reason = "options as they are typed")]
pub struct Devices {
    /// Plan the trainings for so many devices
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    devices: Option<u32>,
    /// What links them: nvlink, infiniband_ndr, infiniband_hdr, ethernet_100g, ethernet_25g, shared_memory
    #[arg(long, value_name = "PRESET", default_value = "infiniband_ndr", value_parser = interconnect, requires = "devices")]
    interconnect: Interconnect,
    /// Bytes per second of the link, measured, instead of the preset's
    #[arg(long, value_name = "B/S", requires = "devices")]
    bandwidth: Option<f64>,
    /// FLOP per second that training comes to on one device: planned FLOP over measured seconds of a run on one
    #[arg(long, value_name = "FLOP/S", requires = "devices")]
    rate: Option<f64>,
}

fn interconnect(name: &str) -> Result<Interconnect, String> {
    let found = INTERCONNECTS.into_iter().find(|preset| preset.name == name);
    found.ok_or_else(|| {
        let names: Vec<&str> = INTERCONNECTS.iter().map(|preset| preset.name).collect();
        format!("the presets are {}", names.join(", "))
    })
}

/// Seconds until a cluster runs again after a failure, failures per day, and what one process writes per second.
const RESTART: f64 = 600.0;
const FAILURES: f64 = 1.0;
const DISK: f64 = 1e9;

impl Devices {
    /// A paragraph per training; nothing where none was asked for.
    ///
    /// # Errors
    /// When a number cannot be used.
    pub fn render(
        &self,
        experiment: &Experiment,
        stages: &[PlannedStage],
    ) -> Result<String, Failure> {
        let Some(devices) = self.devices else {
            return Ok(String::new());
        };
        for (name, value) in [("--rate", self.rate), ("--bandwidth", self.bandwidth)] {
            if value.is_some_and(|value| !(value.is_finite() && value > 0.0)) {
                return Err(Failure::input(format!("`{name}` must be positive"), ""));
            }
        }
        let mut text = String::new();
        for stage in stages {
            let Some((training, checkpoint_every)) = training(experiment, stage) else {
                continue;
            };
            let rate = self.rate.unwrap_or_else(|| training.rate_of_the_paper());
            let mut link = self.interconnect;
            link.bytes_per_second = self.bandwidth.unwrap_or(link.bytes_per_second);
            let cost = training.on(&Cluster {
                devices: f64::from(devices),
                rate,
                interconnect: link,
                overlap: 0.0,
                disk: DISK,
                checkpoint_every,
                failures_per_day: FAILURES,
                restart: RESTART,
            });
            let name = &stage.name;
            let _ = writeln!(text, "\n{name} on {devices} devices over {}", link.name);
            lines(&mut text, &training, &cost);
            let _ = match self.rate {
                Some(_) => Ok(()),
                None => writeln!(
                    text,
                    "    at {:.1} TFLOP/s per device, the rate at which this training takes 256 devices 24 h of computing, the paper's figure; `--rate` for yours",
                    rate / 1e12
                ),
            };
        }
        if text.is_empty() {
            return Err(Failure::input(
                "no stage is a training of MGET whose FLOP are planned",
                "`--devices` is for experiments with `op: train_mget`",
            ));
        }
        Ok(text)
    }
}

/// What the plan says of a training, and how often it writes a checkpoint.
fn training(experiment: &Experiment, stage: &PlannedStage) -> Option<(Training, f64)> {
    let plan = &stage.plan;
    let (steps, _) = plan.work.as_ref()?;
    let training = Training {
        parameters: plan.parameters? as f64,
        steps: *steps as f64,
        flop: plan.flop?,
        tokens: plan.tokens_per_step?,
    };
    let cell = experiment.cells.get(*stage.cells.first()?)?;
    let own = cell
        .graph
        .stages
        .iter()
        .find(|own| own.name == stage.name)?;
    let every = own.settings["checkpoint_every"].as_f64();
    // Where there are none, a failure loses everything: the interval is the training.
    let every = every.filter(|every| *every > 0.0);
    Some((training, every.unwrap_or(training.steps)))
}

fn lines(text: &mut String, training: &Training, cost: &Cost) {
    let step = cost.compute + cost.exposed;
    let giga = |bytes: f64| bytes / 1e9;
    let lines = [
        format!(
            "a step of {:.3} s: computing {:.3} s, reduction {:.3} s ({:.2} GB sent per device, none of it hidden); efficiency {:.0}%",
            step,
            cost.compute,
            cost.exposed,
            giga(cost.wire),
            100.0 * cost.efficiency
        ),
        format!(
            "{:.3} M nominal tokens per second, {:.2} days to 500 G; {:.2} days for this training of {:.0} G, checkpoints and failures counted",
            cost.tokens_per_second / 1e6,
            cost.days_to_500_billion,
            cost.days,
            training.tokens * training.steps / 1e9
        ),
        format!(
            "{:.2} GB of weights, gradients and moments per device; {:.2} GB were the moments sharded (ZeRO-1, which is not there yet); activations besides",
            giga(cost.state),
            giga(cost.sharded_state)
        ),
        format!(
            "checkpoints take {:.2}% of the time (1 GB/s), one failure a day {:.2}% (half an interval, 10 min to restart)",
            100.0 * cost.checkpoints,
            100.0 * cost.failures
        ),
    ];
    for line in lines {
        let _ = writeln!(text, "    {line}");
    }
}
