//! TensorBoard event files: scalars, text, histograms, hyperparameters, and the rewind of steps after a resume.
//!
//! An event file is a sequence of records (length, masked CRC-32C of the length, bytes, masked CRC-32C of the bytes); the
//! bytes are an `Event` protocol buffer. The few messages needed are encoded by hand; the field numbers are those of
//! TensorBoard's `event.proto`, `summary.proto`, `tensor.proto` and the hparams plugin's `plugin_data.proto`.

use serde_json::Value;
use std::io::{self, Write};

/// Writes events to `W`. Time is seconds since 1970, given by the caller.
#[derive(Debug)]
pub struct EventWriter<W: Write> {
    out: W,
    record: Vec<u8>,
}

/// How a session of hyperparameters ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SessionStatus {
    /// The stage finished.
    Success = 1,
    /// The stage failed.
    Failure = 2,
    /// The stage was interrupted, and may go on.
    Running = 3,
}

impl<W: Write> EventWriter<W> {
    /// Starts a file.
    pub fn new(out: W, time: f64) -> io::Result<Self> {
        let record = Vec::with_capacity(1024);
        let mut writer = Self { out, record };
        let mut event = Message::default();
        event.double(1, time);
        event.bytes(3, b"brain.Event:2");
        writer.write(&event)?;
        Ok(writer)
    }

    /// Tells readers to forget what earlier files say of `first_step` and later steps.
    pub fn rewind(&mut self, time: f64, first_step: u64) -> io::Result<()> {
        const START: u64 = 1;
        let mut log = Message::default();
        log.varint(1, START);
        self.event(time, first_step, 7, &log)
    }

    /// Scalars of one step.
    pub fn scalars(&mut self, time: f64, step: u64, scalars: &[(&str, f64)]) -> io::Result<()> {
        let mut summary = Message::default();
        let mut value = Message::default();
        for (tag, scalar) in scalars {
            value.clear();
            value.bytes(1, tag.as_bytes());
            value.float(2, *scalar as f32);
            summary.message(1, &value);
        }
        self.event(time, step, 5, &summary)
    }

    /// Markdown text.
    pub fn text(&mut self, time: f64, step: u64, tag: &str, text: &str) -> io::Result<()> {
        const DT_STRING: u64 = 7;
        let mut dimension = Message::default();
        dimension.varint(1, 1);
        let mut shape = Message::default();
        shape.message(2, &dimension);
        let mut tensor = Message::default();
        tensor.varint(1, DT_STRING);
        tensor.message(2, &shape);
        tensor.bytes(8, text.as_bytes());
        let mut value = Message::default();
        value.bytes(1, tag.as_bytes());
        value.message(8, &tensor);
        value.message(9, &plugin("text", b""));
        self.value(time, step, &value)
    }

    /// The distribution of `values` in 30 buckets of equal width. Values that are not finite are left out.
    pub fn histogram(&mut self, time: f64, step: u64, tag: &str, values: &[f32]) -> io::Result<()> {
        let mut value = Message::default();
        value.bytes(1, tag.as_bytes());
        value.message(5, &Histogram::of(values).encode());
        self.value(time, step, &value)
    }

    /// The hyperparameters of this run (flat: dotted names to scalars), and the metrics to show beside them.
    pub fn hparams(
        &mut self,
        time: f64,
        group: &str,
        hparams: &[(String, Value)],
        metrics: &[&str],
    ) -> io::Result<()> {
        let mut experiment = Message::default();
        experiment.double(3, time);
        let mut start = Message::default();
        for (name, setting) in hparams {
            let (kind, encoded) = setting_value(setting);
            let mut info = Message::default();
            info.bytes(1, name.as_bytes());
            info.varint(4, kind);
            experiment.message(4, &info);
            let mut entry = Message::default();
            entry.bytes(1, name.as_bytes());
            entry.message(2, &encoded);
            start.message(1, &entry);
        }
        for tag in metrics {
            let mut name = Message::default();
            name.bytes(2, tag.as_bytes());
            let mut info = Message::default();
            info.message(1, &name);
            experiment.message(5, &info);
        }
        start.bytes(4, group.as_bytes());
        start.double(5, time);
        self.hparams_value(time, "_hparams_/experiment", 2, &experiment)?;
        self.hparams_value(time, "_hparams_/session_start_info", 3, &start)
    }

    /// How the session that [`EventWriter::hparams`] began has ended.
    pub fn session_end(&mut self, time: f64, status: SessionStatus) -> io::Result<()> {
        let mut end = Message::default();
        end.varint(1, status as u64);
        end.double(2, time);
        self.hparams_value(time, "_hparams_/session_end_info", 4, &end)
    }

    /// Flushes what the events are written to.
    pub fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }

    fn hparams_value(
        &mut self,
        time: f64,
        tag: &str,
        field: u64,
        content: &Message,
    ) -> io::Result<()> {
        let mut data = Message::default();
        data.message(field, content);
        let mut value = Message::default();
        value.bytes(1, tag.as_bytes());
        value.message(9, &plugin("hparams", &data.0));
        self.value(time, 0, &value)
    }

    fn value(&mut self, time: f64, step: u64, value: &Message) -> io::Result<()> {
        let mut summary = Message::default();
        summary.message(1, value);
        self.event(time, step, 5, &summary)
    }

    fn event(&mut self, time: f64, step: u64, field: u64, payload: &Message) -> io::Result<()> {
        let mut event = Message::default();
        event.double(1, time);
        event.varint(2, step);
        event.message(field, payload);
        self.write(&event)
    }

    fn write(&mut self, event: &Message) -> io::Result<()> {
        let length = (event.0.len() as u64).to_le_bytes();
        self.record.clear();
        self.record.extend_from_slice(&length);
        self.record
            .extend_from_slice(&masked_crc(&length).to_le_bytes());
        self.record.extend_from_slice(&event.0);
        self.record
            .extend_from_slice(&masked_crc(&event.0).to_le_bytes());
        self.out.write_all(&self.record)
    }
}

fn plugin(name: &str, content: &[u8]) -> Message {
    let mut data = Message::default();
    data.bytes(1, name.as_bytes());
    data.bytes(2, content);
    let mut metadata = Message::default();
    metadata.message(1, &data);
    metadata
}

/// A setting as `google.protobuf.Value`, with its type in the hparams plugin.
fn setting_value(setting: &Value) -> (u64, Message) {
    const STRING: u64 = 1;
    const BOOL: u64 = 2;
    const FLOAT: u64 = 3;
    let mut value = Message::default();
    let kind = match setting {
        Value::Bool(flag) => {
            value.varint(4, u64::from(*flag));
            BOOL
        }
        Value::Number(number) => {
            value.double(2, number.as_f64().unwrap_or(f64::NAN));
            FLOAT
        }
        Value::String(text) => {
            value.bytes(3, text.as_bytes());
            STRING
        }
        other => {
            value.bytes(3, other.to_string().as_bytes());
            STRING
        }
    };
    (kind, value)
}

struct Histogram {
    min: f64,
    max: f64,
    sum: f64,
    sum_squares: f64,
    limits: Vec<f64>,
    counts: Vec<f64>,
}

impl Histogram {
    const BUCKETS: usize = 30;

    fn of(values: &[f32]) -> Self {
        let finite = || {
            values
                .iter()
                .filter(|v| v.is_finite())
                .map(|&v| f64::from(v))
        };
        let min = finite().fold(f64::INFINITY, f64::min);
        let max = finite().fold(f64::NEG_INFINITY, f64::max);
        let (min, max) = if min <= max { (min, max) } else { (0.0, 0.0) };
        // A single value still needs a bucket with a width.
        let width = ((max - min) / Self::BUCKETS as f64).max(f64::from(f32::MIN_POSITIVE));
        let mut counts = vec![0.0; Self::BUCKETS];
        let (mut sum, mut sum_squares) = (0.0, 0.0);
        for value in finite() {
            let bucket = ((value - min) / width) as usize;
            counts[bucket.min(Self::BUCKETS - 1)] += 1.0;
            sum += value;
            sum_squares += value * value;
        }
        let limits = (1..=Self::BUCKETS)
            .map(|i| min + width * i as f64)
            .collect();
        Self {
            min,
            max,
            sum,
            sum_squares,
            limits,
            counts,
        }
    }

    fn encode(&self) -> Message {
        let mut message = Message::default();
        message.double(1, self.min);
        message.double(2, self.max);
        message.double(3, self.counts.iter().sum());
        message.double(4, self.sum);
        message.double(5, self.sum_squares);
        message.doubles(6, &self.limits);
        message.doubles(7, &self.counts);
        message
    }
}

/// A protocol buffer message under construction.
#[derive(Debug, Default, Clone)]
struct Message(Vec<u8>);

impl Message {
    fn clear(&mut self) {
        self.0.clear();
    }

    fn raw_varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn tag(&mut self, field: u64, wire_type: u64) {
        self.raw_varint(field << 3 | wire_type);
    }

    fn varint(&mut self, field: u64, value: u64) {
        self.tag(field, 0);
        self.raw_varint(value);
    }

    fn double(&mut self, field: u64, value: f64) {
        self.tag(field, 1);
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    fn float(&mut self, field: u64, value: f32) {
        self.tag(field, 5);
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    fn bytes(&mut self, field: u64, value: &[u8]) {
        self.tag(field, 2);
        self.raw_varint(value.len() as u64);
        self.0.extend_from_slice(value);
    }

    fn message(&mut self, field: u64, value: &Message) {
        self.bytes(field, &value.0);
    }

    fn doubles(&mut self, field: u64, values: &[f64]) {
        self.tag(field, 2);
        self.raw_varint(values.len() as u64 * 8);
        for value in values {
            self.0.extend_from_slice(&value.to_le_bytes());
        }
    }
}

/// CRC-32C with TensorFlow's mask.
fn masked_crc(bytes: &[u8]) -> u32 {
    crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}

fn crc32c(bytes: &[u8]) -> u32 {
    static TABLE: [u32; 256] = table();
    let mut crc = !0;
    for &byte in bytes {
        crc = crc >> 8 ^ TABLE[usize::from(crc as u8 ^ byte)];
    }
    !crc
}

const fn table() -> [u32; 256] {
    const REVERSED_CASTAGNOLI: u32 = 0x82f6_3b78;
    let mut table = [0; 256];
    let mut i = 0;
    while i < 256 {
        let mut crc = i as u32;
        let mut bit = 0;
        while bit < 8 {
            crc = if crc & 1 == 1 {
                crc >> 1 ^ REVERSED_CASTAGNOLI
            } else {
                crc >> 1
            };
            bit += 1;
        }
        table[i] = crc;
        i += 1;
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksums_are_castagnoli() {
        // RFC 3720, B.4.
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(crc32c(b"123456789"), 0xe306_9283);
    }

    #[test]
    fn records_carry_their_length_and_both_checksums() {
        let mut bytes = Vec::new();
        EventWriter::new(&mut bytes, 1.0).unwrap();
        let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        assert_eq!(bytes.len(), 8 + 4 + length + 4);
        let crc =
            |range: std::ops::Range<usize>| u32::from_le_bytes(bytes[range].try_into().unwrap());
        assert_eq!(crc(8..12), masked_crc(&bytes[..8]));
        assert_eq!(
            crc(12 + length..16 + length),
            masked_crc(&bytes[12..12 + length])
        );
    }

    #[test]
    fn a_histogram_counts_every_finite_value_once() {
        for values in [
            vec![],
            vec![2.0],
            vec![f32::NAN, 1.0, f32::INFINITY],
            vec![-3.0, 0.0, 0.1, 7.0, 7.0],
        ] {
            let histogram = Histogram::of(&values);
            let finite = values.iter().filter(|v| v.is_finite()).count();
            assert_eq!(histogram.counts.iter().sum::<f64>(), finite as f64);
            assert!(histogram.limits.is_sorted());
        }
    }
}
