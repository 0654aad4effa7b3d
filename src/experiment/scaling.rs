//! What a training takes on many devices: a model of one step of data-parallel training, of its memory, and of what checkpoints and
//! failures cost.
//!
//! A step is computing, which is divided by the number of devices, and a reduction of gradients. Buckets of gradients are on their way
//! while backward computes the next ones: as much of the reduction is hidden as there is backward beside it, but never the last bucket,
//! and never what the devices themselves do for it, such as processors that copy what they send.

use serde::Serialize;

/// Bytes of a parameter in f32.
const F32: f64 = 4.0;

/// What links devices.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Interconnect {
    /// As it is written after `--interconnect`.
    pub name: &'static str,
    /// Bytes per second that a device sends while it receives as many, in a reduction.
    pub bytes_per_second: f64,
    /// Seconds of one message.
    pub latency: f64,
    /// Share of a reduction in which the devices themselves are busy with it, and compute nothing.
    pub busy: f64,
}

/// Presets: four fifths of what the links are sold as, which is what reductions of large arrays come to; `shared_memory` is OpenMPI
/// between processes of one machine, all of whose cores compute.
pub const INTERCONNECTS: [Interconnect; 6] = [
    preset("nvlink", 360e9, 5e-6, 0.0),
    preset("infiniband_ndr", 40e9, 10e-6, 0.0),
    preset("infiniband_hdr", 20e9, 10e-6, 0.0),
    preset("ethernet_100g", 10e9, 30e-6, 0.0),
    preset("ethernet_25g", 2.5e9, 50e-6, 0.0),
    preset("shared_memory", 0.6e9, 100e-6, 1.0),
];

const fn preset(
    name: &'static str,
    bytes_per_second: f64,
    latency: f64,
    busy: f64,
) -> Interconnect {
    Interconnect {
        name,
        bytes_per_second,
        latency,
        busy,
    }
}

/// A training, as its plan has it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Training {
    /// Trainable parameters.
    pub parameters: f64,
    /// Steps of the whole training.
    pub steps: f64,
    /// Of the whole training.
    pub flop: f64,
    /// Nominal tokens of a step.
    pub tokens: f64,
    /// Each device keeps its share of the optimizer's moments alone (ZeRO stage 1).
    pub sharded: bool,
}

/// What it runs on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cluster {
    /// How many devices train together.
    pub devices: f64,
    /// Floating point operations per second that training comes to on one device.
    pub rate: f64,
    /// What links them.
    pub interconnect: Interconnect,
    /// Share of computing behind which the reduction can hide: the backward passes after which devices add up gradients.
    pub overlap: f64,
    /// How often devices exchange their gradients in a step: once, or after each of their micro-batches.
    pub exchanges: f64,
    /// Bytes per second that one process writes to the file system.
    pub disk: f64,
    /// Steps between checkpoints.
    pub checkpoint_every: f64,
    /// Failures per day of the whole cluster.
    pub failures_per_day: f64,
    /// Seconds until it runs again.
    pub restart: f64,
}

/// What it takes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Cost {
    /// Seconds of computing in a step.
    pub compute: f64,
    /// Bytes that a device sends in a step.
    pub wire: f64,
    /// Seconds of the reduction, hidden or not.
    pub reduction: f64,
    /// Seconds of exchanges that nothing hides.
    pub exposed: f64,
    /// Computing's share of a step.
    pub efficiency: f64,
    /// Nominal tokens per second of all devices together.
    pub tokens_per_second: f64,
    /// Days to 500 billion tokens, as the paper trains (Supp. B); without checkpoints and failures.
    pub days_to_500_billion: f64,
    /// Days of the training as it is planned, with checkpoints and failures.
    pub days: f64,
    /// Bytes per device of weights, gradients and two moments, all of them on each.
    pub whole_state: f64,
    /// The same where each has its share of the moments.
    pub sharded_state: f64,
    /// Share of the time that goes into writing checkpoints.
    pub checkpoints: f64,
    /// Share of the time that is lost to failures: half an interval, and the restart.
    pub failures: f64,
}

impl Training {
    /// What it takes on a cluster.
    #[must_use]
    pub fn on(&self, cluster: &Cluster) -> Cost {
        let n = cluster.devices;
        let gradient = F32 * self.parameters;
        let compute = self.flop / self.steps / (n * cluster.rate);
        // A part of every bucket to each of the others in each exchange, and the sums back.
        let one = gradient * (n - 1.0) / n;
        // A mebibyte to each of the others, as long as that is at most 25.
        let buckets = (gradient / (n.min(25.0) * 1024.0 * 1024.0)).ceil();
        let link = &cluster.interconnect;
        let seconds = |bytes: f64, times: f64| {
            bytes / link.bytes_per_second + times * buckets * (n - 1.0) * link.latency
        };
        let travels = cluster.exchanges + 1.0;
        let reduction = seconds(travels * one, travels);
        let last = reduction / buckets;
        let hidden = cluster.overlap * compute;
        let busy = link.busy * reduction;
        let mut exposed = busy + (reduction - busy - hidden).max((1.0 - link.busy) * last);
        let mut wire = travels * one;
        if self.sharded {
            // What each has moved goes to the others, when there is nothing left to compute.
            wire += one;
            exposed += seconds(one, 1.0);
        }
        let step = compute + exposed;
        let tokens_per_second = self.tokens / step;
        let day = 86400.0;
        // Weights and two moments.
        let written = 3.0 * gradient / cluster.disk;
        let interval = cluster.checkpoint_every * step;
        let checkpoints = written / (interval + written);
        let lost = 0.5 * (interval + written) + cluster.restart;
        let failures = (cluster.failures_per_day * lost / day).min(1.0);
        let useful = (1.0 - checkpoints) * (1.0 - failures);
        Cost {
            compute,
            wire,
            reduction,
            exposed,
            efficiency: compute / step,
            tokens_per_second,
            days_to_500_billion: 500e9 / tokens_per_second / day,
            days: self.steps * step / useful / day,
            whole_state: 4.0 * gradient,
            sharded_state: 2.0 * gradient + 2.0 * gradient / n,
            checkpoints,
            failures,
        }
    }

    /// The rate per device at which the paper's figure comes out: 24 h on 256 H100.
    #[must_use]
    pub fn rate_of_the_paper(&self) -> f64 {
        self.flop / (24.0 * 3600.0 * 256.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Roughly the paper's large model: 123 epochs of a million clips.
    const LARGE: Training = Training {
        parameters: 400e6,
        steps: 120_000.0,
        flop: 6.0 * 400e6 * 300e9,
        tokens: 1024.0 * 4096.0,
        sharded: false,
    };

    fn cluster(devices: f64) -> Cluster {
        Cluster {
            devices,
            rate: 100e12,
            interconnect: INTERCONNECTS[1],
            overlap: 0.0,
            exchanges: 1.0,
            disk: 1e9,
            checkpoint_every: 500.0,
            failures_per_day: 1.0,
            restart: 600.0,
        }
    }

    #[test]
    fn one_device_sends_nothing_and_computes_all() {
        let cost = LARGE.on(&cluster(1.0));
        assert_eq!((cost.wire, cost.exposed, cost.efficiency), (0.0, 0.0, 1.0));
        assert_eq!(cost.whole_state, cost.sharded_state);
        let seconds = LARGE.flop / 100e12;
        assert!((cost.compute * LARGE.steps / seconds - 1.0).abs() < 1e-9);
    }

    #[test]
    fn more_devices_are_faster_and_less_efficient_and_overlap_helps() {
        let costs = [1.0, 8.0, 64.0, 256.0].map(|devices| LARGE.on(&cluster(devices)));
        for pair in costs.windows(2) {
            assert!(pair[1].days < pair[0].days && pair[1].efficiency < pair[0].efficiency);
        }
        let hidden = Cluster {
            overlap: 0.5,
            ..cluster(8.0)
        };
        let hidden = LARGE.on(&hidden);
        assert!(hidden.exposed < costs[1].exposed && hidden.reduction == costs[1].reduction);
        // Nothing is left for the last of 191 buckets to hide behind.
        let all = Cluster {
            overlap: 1.0,
            ..cluster(8.0)
        };
        let found = LARGE.on(&all);
        assert!(
            (found.exposed / found.reduction - 1.0 / 191.0).abs() < 1e-4,
            "{found:?}"
        );
        // What the devices do themselves hides behind nothing.
        let mut busy = all;
        busy.interconnect.busy = 0.25;
        let exposed = LARGE.on(&busy).exposed;
        let expected = (0.25 + 0.75 / 191.0) * found.reduction;
        assert!((exposed / expected - 1.0).abs() < 1e-3, "{exposed}");
        // Moments over 256 devices: half of the state, and hardly more.
        assert!((costs[3].sharded_state / costs[3].whole_state - 0.502).abs() < 1e-3);
    }

    #[test]
    fn shared_moments_and_exchanges_after_every_micro_batch_are_sent_too() {
        let plain = LARGE.on(&cluster(8.0));
        let sharded = Training {
            sharded: true,
            ..LARGE
        };
        let sharded = sharded.on(&cluster(8.0));
        assert!((sharded.wire / plain.wire - 1.5).abs() < 1e-9);
        assert!((sharded.exposed / plain.exposed - 1.5).abs() < 1e-9);
        let ordered = LARGE.on(&Cluster {
            exchanges: 4.0,
            ..cluster(8.0)
        });
        assert!((ordered.wire / plain.wire - 2.5).abs() < 1e-9);
    }

    #[test]
    fn checkpoints_and_failures_cost_what_they_take() {
        let cost = LARGE.on(&cluster(256.0));
        let step = cost.compute + cost.exposed;
        let written = 12.0 * LARGE.parameters / 1e9;
        assert!((cost.checkpoints - written / (500.0 * step + written)).abs() < 1e-9);
        let lost = 0.5 * (500.0 * step + written) + 600.0;
        assert!((cost.failures - lost / 86400.0).abs() < 1e-9);
    }
}
