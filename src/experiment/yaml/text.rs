//! Bytes to text, and plain text to values.

use super::{Data, MAX_BYTES};
use crate::experiment::diagnostic::{Diagnostic, Span};
use crate::experiment::problem::Code;
use crate::formats::text;
use std::borrow::Cow;

/// Reads bytes as text: size, encoding.
///
/// # Errors
/// One diagnostic that says what the file is instead.
pub fn decode(bytes: &[u8], layer: u32) -> Result<Cow<'_, str>, Box<Diagnostic>> {
    let start = Span::point(layer, 0);
    if bytes.len() > MAX_BYTES {
        return Err(Box::new(
            Diagnostic::new(
                Code::E0101,
                start,
                format!(
                    "the file has {} bytes or more; an experiment has at most {MAX_BYTES}",
                    bytes.len()
                ),
            )
            .help("data does not belong in an experiment: name a file or a data set"),
        ));
    }
    if bytes.starts_with(b"\xff\xfe") || bytes.starts_with(b"\xfe\xff") {
        let diagnostic = Diagnostic::new(Code::E0101, start, "the file is UTF-16, not UTF-8");
        return Err(Box::new(diagnostic.help("save it as UTF-8")));
    }
    let text = std::str::from_utf8(bytes).map_err(|error| {
        Box::new(
            Diagnostic::new(
                Code::E0101,
                start,
                format!(
                    "the file is not UTF-8: byte {} is no part of a character",
                    error.valid_up_to()
                ),
            )
            .help("save it as UTF-8, or name a YAML file"),
        )
    })?;
    if let Some(position) = bytes.iter().position(|&byte| byte == 0) {
        return Err(Box::new(
            Diagnostic::new(
                Code::E0101,
                start,
                format!("the file is binary: byte {position} is zero"),
            )
            .help("name a YAML file"),
        ));
    }
    Ok(text::yaml(text))
}

/// A plain scalar by the YAML 1.2 core schema.
pub fn plain(text: &str) -> Data {
    match text {
        "" | "~" | "null" | "Null" | "NULL" => return Data::Null,
        "true" | "True" | "TRUE" => return Data::Bool(true),
        "false" | "False" | "FALSE" => return Data::Bool(false),
        ".inf" | ".Inf" | ".INF" | "+.inf" | "+.Inf" | "+.INF" => {
            return Data::Float(f64::INFINITY);
        }
        "-.inf" | "-.Inf" | "-.INF" => return Data::Float(f64::NEG_INFINITY),
        ".nan" | ".NaN" | ".NAN" => return Data::Float(f64::NAN),
        _ => {}
    }
    let digits = text.strip_prefix(['-', '+']).unwrap_or(text);
    if !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit()) {
        if let Ok(value) = text.parse::<i64>() {
            return Data::Int(value);
        }
        return text
            .parse::<f64>()
            .map_or_else(|_| Data::Text(text.to_owned()), Data::Float);
    }
    for (prefix, radix) in [("0x", 16), ("0o", 8)] {
        if let Some(digits) = text.strip_prefix(prefix)
            && let Ok(value) = i64::from_str_radix(digits, radix)
        {
            return Data::Int(value);
        }
    }
    let numeric = digits
        .bytes()
        .all(|byte| byte.is_ascii_digit() || matches!(byte, b'.' | b'e' | b'E' | b'-' | b'+'))
        && digits
            .bytes()
            .next()
            .is_some_and(|byte| byte.is_ascii_digit() || byte == b'.')
        && digits.bytes().any(|byte| byte.is_ascii_digit());
    if numeric && let Ok(value) = text.parse::<f64>() {
        return Data::Float(value);
    }
    Data::Text(text.to_owned())
}
