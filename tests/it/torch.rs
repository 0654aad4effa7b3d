//! Writes files as torch does, for tests and benches: a pickle by hand in a zip archive.

use reviv::formats::zip::ZipWriter;
use std::io::Write;

/// A tensor whose values are made when they are written.
pub struct Saved {
    pub name: String,
    pub shape: Vec<usize>,
    /// Index of the tensor whose storage this one shares.
    pub alias_of: Option<usize>,
    pub values: Box<dyn Fn() -> Vec<f32>>,
}

/// A value of `args`.
pub enum Argument {
    Text(String),
    Number(i32),
    Texts(Vec<String>),
}

fn text(out: &mut Vec<u8>, text: &str) {
    out.push(b'X');
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.as_bytes());
}

fn number(out: &mut Vec<u8>, value: i64) {
    out.push(b'J');
    out.extend((value as i32).to_le_bytes());
}

fn sizes(out: &mut Vec<u8>, values: &[usize]) {
    out.push(b'(');
    for value in values {
        number(out, *value as i64);
    }
    out.push(b't');
}

/// The opcodes that rebuild one tensor.
pub fn tensor(key: usize, elements: usize, shape: &[usize], strides: &[usize]) -> Vec<u8> {
    let mut out = b"ctorch._utils\n_rebuild_tensor_v2\n((".to_vec();
    text(&mut out, "storage");
    out.extend(b"ctorch\nFloatStorage\n");
    text(&mut out, &key.to_string());
    text(&mut out, "cpu");
    number(&mut out, elements as i64);
    out.extend(b"tQ");
    number(&mut out, 0);
    sizes(&mut out, shape);
    sizes(&mut out, strides);
    out.extend(b"\x89ccollections\nOrderedDict\n)RtR");
    out
}

pub fn strides(shape: &[usize]) -> Vec<usize> {
    let mut strides = vec![1; shape.len()];
    for axis in (1..shape.len()).rev() {
        strides[axis - 1] = strides[axis] * shape[axis];
    }
    strides
}

/// `{"model": OrderedDict, "args": Namespace}` around opcodes that build each tensor.
pub fn pickle(tensors: &[(String, Vec<u8>)], arguments: &[(&str, Argument)]) -> Vec<u8> {
    let mut out = b"\x80\x02}(".to_vec();
    text(&mut out, "model");
    out.extend(b"ccollections\nOrderedDict\n)R(");
    for (name, opcodes) in tensors {
        text(&mut out, name);
        out.extend(opcodes);
    }
    out.push(b'u');
    text(&mut out, "args");
    out.extend(b"cargparse\nNamespace\n)\x81}(");
    for (key, value) in arguments {
        text(&mut out, key);
        match value {
            Argument::Text(value) => text(&mut out, value),
            Argument::Number(value) => number(&mut out, (*value).into()),
            Argument::Texts(values) => {
                out.extend(b"](");
                for value in values {
                    text(&mut out, value);
                }
                out.push(b'e');
            }
        }
    }
    out.extend(b"ubu.");
    out
}

/// A TorchScript module of modules: `(module, name, tensor)`.
pub fn script(tensors: &[(&str, &str, Vec<u8>)]) -> Vec<u8> {
    let mut out = b"\x80\x02c__torch__\nModel\n)\x81}(".to_vec();
    for (module, name, opcodes) in tensors {
        text(&mut out, module);
        out.extend(b"c__torch__.inner\nModule\n)\x81}(");
        text(&mut out, name);
        out.extend(opcodes);
        text(&mut out, "training");
        out.extend(b"\x89ub");
    }
    out.extend(b"ub.");
    out
}

/// An `OrderedDict` of tensors at the top: the form of a bare state dictionary.
fn state(tensors: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut out = b"\x80\x02ccollections\nOrderedDict\n)R(".to_vec();
    for (name, opcodes) in tensors {
        text(&mut out, name);
        out.extend(opcodes);
    }
    out.extend(b"u.");
    out
}

/// As [`save`], with the tensors at the top of the file.
pub fn save_state(out: impl Write, tensors: &[Saved]) {
    write(out, tensors, state);
}

/// Writes a `.pth` file; storages are made one at a time.
pub fn save(out: impl Write, tensors: &[Saved], arguments: &[(&str, Argument)]) {
    write(out, tensors, |described| pickle(described, arguments));
}

fn write(
    out: impl Write,
    tensors: &[Saved],
    pickled: impl FnOnce(&[(String, Vec<u8>)]) -> Vec<u8>,
) {
    let described: Vec<(String, Vec<u8>)> = tensors
        .iter()
        .enumerate()
        .map(|(index, saved)| {
            let count = saved.shape.iter().product();
            let key = saved.alias_of.unwrap_or(index);
            let opcodes = tensor(key, count, &saved.shape, &strides(&saved.shape));
            (saved.name.clone(), opcodes)
        })
        .collect();
    let mut zip = ZipWriter::new(out);
    zip.add("checkpoint/data.pkl", &pickled(&described))
        .unwrap();
    zip.add("checkpoint/byteorder", b"little").unwrap();
    for (index, saved) in tensors.iter().enumerate() {
        if saved.alias_of.is_none() {
            let bytes: Vec<u8> = (saved.values)()
                .iter()
                .flat_map(|v| v.to_le_bytes())
                .collect();
            zip.add(&format!("checkpoint/data/{index}"), &bytes)
                .unwrap();
        }
    }
    zip.finish().unwrap();
}
