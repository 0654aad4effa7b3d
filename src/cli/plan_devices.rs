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
            let Some(planned) = planned(experiment, stage, f64::from(devices)) else {
                continue;
            };
            let training = planned.training;
            let rate = self.rate.unwrap_or_else(|| training.rate_of_the_paper());
            let mut link = self.interconnect;
            link.bytes_per_second = self.bandwidth.unwrap_or(link.bytes_per_second);
            let cost = training.on(&Cluster {
                devices: f64::from(devices),
                rate,
                interconnect: link,
                overlap: planned.overlap,
                exchanges: planned.exchanges,
                disk: DISK,
                checkpoint_every: planned.checkpoint_every,
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

/// Backward's share of computing.
const BACKWARD: f64 = 2.0 / 3.0;

/// What the plan and the settings say of a training on so many devices.
struct Planned {
    training: Training,
    /// Steps.
    checkpoint_every: f64,
    overlap: f64,
    exchanges: f64,
}

fn planned(experiment: &Experiment, stage: &PlannedStage, devices: f64) -> Option<Planned> {
    let plan = &stage.plan;
    let (steps, _) = plan.work.as_ref()?;
    let cell = experiment.cells.get(*stage.cells.first()?)?;
    let own = cell
        .graph
        .stages
        .iter()
        .find(|own| own.name == stage.name)?;
    let settings = own.settings.json();
    let training = Training {
        parameters: plan.parameters? as f64,
        steps: *steps as f64,
        flop: plan.flop?,
        tokens: plan.tokens_per_step?,
        sharded: settings["optimizer"]["shard"] == true && devices > 1.0,
    };
    let every = settings["checkpoint_every"].as_f64();
    // Where there are none, a failure loses everything: the interval is the training.
    let every = every.filter(|every| *every > 0.0);
    let size = settings["micro_batch"].as_f64().filter(|size| *size > 0.0);
    let batch = settings["batch"].as_f64().unwrap_or(1.0);
    // Of one device; by default it has one.
    let micro_batches = size.map_or(1.0, |size| ((batch / size).ceil() / devices).max(1.0));
    let ordered = settings["reduction"] == "ordered";
    let (exchanges, overlap) = if ordered {
        (micro_batches, BACKWARD)
    } else {
        (1.0, BACKWARD / micro_batches)
    };
    Some(Planned {
        checkpoint_every: every.unwrap_or(training.steps),
        training,
        overlap,
        exchanges,
    })
}

fn lines(text: &mut String, training: &Training, cost: &Cost) {
    let step = cost.compute + cost.exposed;
    let giga = |bytes: f64| bytes / 1e9;
    let lines = [
        format!(
            "a step of {:.3} s: computing {:.3} s, exchanges that backward does not hide {:.3} s ({:.2} GB sent per device); efficiency {:.0}%",
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
        if training.sharded {
            format!(
                "{:.2} GB of weights, gradients and a share of the moments per device; {:.2} GB without `optimizer: {{shard: true}}`; activations besides",
                giga(cost.sharded_state),
                giga(cost.whole_state),
            )
        } else {
            format!(
                "{:.2} GB of weights, gradients and moments per device; {:.2} GB with `optimizer: {{shard: true}}`; activations besides",
                giga(cost.whole_state),
                giga(cost.sharded_state),
            )
        },
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
