//! Numbers out of a pickle: NumPy arrays, torch tensors and lists of numbers, read when they are asked for.

use super::{Id, Node, Pickle, Scalar, StoredBytes, TensorView};
use crate::formats::ReadError;
use crate::formats::npy::{self, Dtype, NpyArray, NpyData};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// An array that may still be in its file: outlives the pickle it was found in.
#[derive(Debug, Clone)]
pub struct StoredArray {
    dtype: Dtype,
    /// The length of each axis, the slowest first in C order.
    pub shape: Vec<usize>,
    fortran: bool,
    place: Place,
    /// The pickle's file, where it has one.
    path: Option<PathBuf>,
}

#[derive(Debug, Clone)]
enum Place {
    Memory(Vec<u8>),
    File { offset: u64, length: u64 },
}

impl StoredArray {
    /// The array, in C order.
    ///
    /// # Errors
    /// When the file cannot be read any more.
    pub fn read(&self) -> Result<NpyArray, ReadError> {
        let read;
        let path = self.path.as_deref().unwrap_or(Path::new(""));
        let bytes = match &self.place {
            Place::Memory(bytes) => bytes,
            Place::File { offset, length } => {
                let mut file = File::open(path).map_err(|cause| ReadError::io(path, cause))?;
                let mut bytes = vec![0; *length as usize];
                file.seek(SeekFrom::Start(*offset))
                    .and_then(|_| file.read_exact(&mut bytes))
                    .map_err(|cause| ReadError::io(path, cause))?;
                read = bytes;
                &read
            }
        };
        npy::from_parts(self.dtype.code(), self.fortran, &self.shape, bytes).map_err(|error| {
            ReadError::Format(match &self.path {
                Some(path) => error.in_file(path),
                None => error,
            })
        })
    }
}

impl Pickle {
    /// Where the numbers of an object are: of a NumPy array, a torch tensor, a number, or a list of numbers. Objects of chumpy
    /// that only hold an array are that array.
    ///
    /// # Errors
    /// A sentence that says what it is instead.
    pub fn numbers(&self, id: Id) -> Result<StoredArray, String> {
        match self.node(id) {
            Node::Array(array) => {
                let dtype = Dtype::from_code(&array.dtype).ok_or_else(|| {
                    format!("an array of type `{}` holds no numbers", array.dtype)
                })?;
                let count = array
                    .shape
                    .iter()
                    .try_fold(1usize, |n, &d| n.checked_mul(d));
                let expected = count.and_then(|count| count.checked_mul(dtype.width()));
                let there = match array.bytes.map(|bytes| self.node(bytes)) {
                    Some(Node::Bytes(bytes)) => Some(bytes.len()),
                    Some(Node::Text(text)) => Some(text.len()),
                    Some(Node::Stored(StoredBytes::File { length, .. })) => Some(*length as usize),
                    _ => None,
                };
                if expected.is_none() || expected != there {
                    let bytes = there.unwrap_or(0);
                    let shape = &array.shape;
                    return Err(format!("an array of shape {shape:?} over {bytes} bytes"));
                }
                Ok(StoredArray {
                    dtype,
                    shape: array.shape.clone(),
                    fortran: array.fortran,
                    place: match array.bytes.map(|bytes| self.node(bytes)) {
                        Some(Node::Bytes(bytes)) => Place::Memory(bytes.clone()),
                        Some(Node::Text(text)) => Place::Memory(text.clone().into_bytes()),
                        Some(Node::Stored(stored)) => self.place(stored)?,
                        _ => return Err("an array without data".to_owned()),
                    },
                    path: self.path.clone(),
                })
            }
            Node::Tensor(view) => self.tensor(view),
            Node::Object { class, .. } if &**class == "chumpy.ch.Ch" => {
                let inner = self.get(id, "x").ok_or("a chumpy object without numbers")?;
                match self.node(inner) {
                    // One level is what there is; more would be a chain without end.
                    Node::Object { .. } => Err("a chumpy object inside another one".to_owned()),
                    _ => self.numbers(inner),
                }
            }
            Node::Int(_) | Node::Float(_) | Node::Bool(_) => self.list(&[id], Vec::new()),
            Node::List(items) | Node::Tuple(items) => self.list(items, vec![items.len()]),
            _ => Err("neither an array nor a number".to_owned()),
        }
    }

    fn list(&self, items: &[Id], shape: Vec<usize>) -> Result<StoredArray, String> {
        let values = items.iter().map(|&item| match self.node(item) {
            Node::Int(value) => Ok(*value as f64),
            Node::Float(value) => Ok(*value),
            Node::Bool(value) => Ok(f64::from(u8::from(*value))),
            _ => Err("a list of something that is not numbers".to_owned()),
        });
        let mut bytes = Vec::with_capacity(items.len() * 8);
        for value in values {
            bytes.extend(value?.to_le_bytes());
        }
        Ok(StoredArray {
            dtype: Dtype::F64,
            shape,
            fortran: false,
            place: Place::Memory(bytes),
            path: self.path.clone(),
        })
    }

    fn place(&self, stored: &StoredBytes) -> Result<Place, String> {
        match stored {
            StoredBytes::File { offset, length } => Ok(Place::File {
                offset: *offset,
                length: *length,
            }),
            StoredBytes::Node { id, start } => match self.node(*id) {
                Node::Bytes(bytes) => Ok(Place::Memory(
                    bytes.get(*start as usize..).unwrap_or(&[]).to_vec(),
                )),
                _ => Err("an array without data".to_owned()),
            },
        }
    }

    fn tensor(&self, view: &TensorView) -> Result<StoredArray, String> {
        let stored = self
            .storages
            .get(&view.storage.key)
            .ok_or("a tensor whose numbers are not in this file")?;
        let dtype = match view.storage.scalar {
            Scalar::F64 => Dtype::F64,
            Scalar::F32 => Dtype::F32,
            Scalar::F16 => Dtype::F16,
            Scalar::I64 => Dtype::I64,
            Scalar::I32 => Dtype::I32,
            Scalar::I16 => Dtype::I16,
            Scalar::I8 => Dtype::I8,
            Scalar::U8 => Dtype::U8,
            Scalar::Bool => Dtype::Bool,
            other => return Err(format!("a tensor of {}", other.name())),
        };
        let width = dtype.width() as u64;
        let shape: Vec<usize> = view.shape.iter().map(|d| *d as usize).collect();
        let length = view.elements() * width;
        let mut place = self.place(stored)?;
        if view.is_contiguous() {
            let first = view.offset * width;
            match &mut place {
                Place::Memory(bytes) => {
                    *bytes = bytes
                        .get(first as usize..(first + length) as usize)
                        .ok_or("a tensor beyond its storage")?
                        .to_vec();
                }
                Place::File {
                    offset,
                    length: all,
                    ..
                } => {
                    *offset += first;
                    *all = length;
                }
            }
            return Ok(StoredArray {
                dtype,
                shape,
                fortran: false,
                place,
                path: self.path.clone(),
            });
        }
        // A transposed view is small here: its elements are gathered.
        let whole = StoredArray {
            dtype: Dtype::U8,
            shape: vec![(view.storage.elements * width) as usize],
            fortran: false,
            place,
            path: self.path.clone(),
        };
        let NpyData::U8(bytes) = whole.read().map_err(|error| error.to_string())?.data else {
            return Err("a tensor without data".to_owned());
        };
        let mut gathered = Vec::with_capacity(length as usize);
        for element in 0..view.elements() {
            let (mut left, mut at) = (element, view.offset);
            for (size, stride) in view.shape.iter().zip(&view.strides).rev() {
                at += left % size * stride;
                left /= size;
            }
            let first = (at * width) as usize;
            let element = bytes.get(first..first + width as usize);
            gathered.extend_from_slice(element.ok_or("a tensor beyond its storage")?);
        }
        Ok(StoredArray {
            dtype,
            shape,
            fortran: false,
            place: Place::Memory(gathered),
            path: self.path.clone(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    /// `pickle.dumps({"a": np.array([[1.5, 2, 3]], "<f4")}, protocol)` of numpy 2.4, protocols 2 to 5.
    const PROTOCOLS: [&[u8]; 4] = [
        b"\x80\x02}q\x00X\x01\x00\x00\x00aq\x01cnumpy._core.multiarray\x0a_reconstruct\x0aq\x02cnumpy\x0andarray\x0aq\x03K\x00\x85q\x04c_codecs\x0aencode\x0aq\x05X\x01\x00\x00\x00bq\x06X\x06\x00\x00\x00latin1q\x07\x86q\x08Rq\x09\x87q\x0aRq\x0b(K\x01K\x01K\x03\x86q\x0ccnumpy\x0adtype\x0aq\x0dX\x02\x00\x00\x00f4q\x0e\x89\x88\x87q\x0fRq\x10(K\x03X\x01\x00\x00\x00<q\x11NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tq\x12b\x89h\x05X\x0d\x00\x00\x00\x00\x00\xc3\x80?\x00\x00\x00@\x00\x00@@q\x13h\x07\x86q\x14Rq\x15tq\x16bs.",
        b"\x80\x03}q\x00X\x01\x00\x00\x00aq\x01cnumpy._core.multiarray\x0a_reconstruct\x0aq\x02cnumpy\x0andarray\x0aq\x03K\x00\x85q\x04C\x01bq\x05\x87q\x06Rq\x07(K\x01K\x01K\x03\x86q\x08cnumpy\x0adtype\x0aq\x09X\x02\x00\x00\x00f4q\x0a\x89\x88\x87q\x0bRq\x0c(K\x03X\x01\x00\x00\x00<q\x0dNNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tq\x0eb\x89C\x0c\x00\x00\xc0?\x00\x00\x00@\x00\x00@@q\x0ftq\x10bs.",
        b"\x80\x04\x95\x9e\x00\x00\x00\x00\x00\x00\x00}\x94\x8c\x01a\x94\x8c\x16numpy._core.multiarray\x94\x8c\x0c_reconstruct\x94\x93\x94\x8c\x05numpy\x94\x8c\x07ndarray\x94\x93\x94K\x00\x85\x94C\x01b\x94\x87\x94R\x94(K\x01K\x01K\x03\x86\x94h\x05\x8c\x05dtype\x94\x93\x94\x8c\x02f4\x94\x89\x88\x87\x94R\x94(K\x03\x8c\x01<\x94NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00t\x94b\x89C\x0c\x00\x00\xc0?\x00\x00\x00@\x00\x00@@\x94t\x94bs.",
        b"\x80\x05\x95\x89\x00\x00\x00\x00\x00\x00\x00}\x94\x8c\x01a\x94\x8c\x13numpy._core.numeric\x94\x8c\x0b_frombuffer\x94\x93\x94(\x96\x0c\x00\x00\x00\x00\x00\x00\x00\x00\x00\xc0?\x00\x00\x00@\x00\x00@@\x94\x8c\x05numpy\x94\x8c\x05dtype\x94\x93\x94\x8c\x02f4\x94\x89\x88\x87\x94R\x94(K\x03\x8c\x01<\x94NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00t\x94bK\x01K\x03\x86\x94\x8c\x01C\x94t\x94R\x94s.",
    ];
    /// `pickle.dumps(np.asfortranarray(np.array([[1, 2], [3, 4]], "<i2")), 4)`.
    const FORTRAN: &[u8] = b"\x80\x04\x95\x93\x00\x00\x00\x00\x00\x00\x00\x8c\x16numpy._core.multiarray\x94\x8c\x0c_reconstruct\x94\x93\x94\x8c\x05numpy\x94\x8c\x07ndarray\x94\x93\x94K\x00\x85\x94C\x01b\x94\x87\x94R\x94(K\x01K\x02K\x02\x86\x94h\x03\x8c\x05dtype\x94\x93\x94\x8c\x02i2\x94\x89\x88\x87\x94R\x94(K\x03\x8c\x01<\x94NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00t\x94b\x88C\x08\x01\x00\x03\x00\x02\x00\x04\x00\x94t\x94b.";
    /// `t = torch.tensor([[1., 2.], [3., 4.]]); pickle.dumps({"t": t.T, "u": t[1]}, 2)`.
    const TENSORS: &[u8] = b"\x80\x02}q\x00(X\x01\x00\x00\x00tq\x01ctorch._utils\x0a_rebuild_tensor_v2\x0aq\x02(ctorch.storage\x0a_load_from_bytes\x0aq\x03c_codecs\x0aencode\x0aq\x04X\x1a\x01\x00\x00\xc2\x80\x02\xc2\x8a\x0al\xc3\xbc\xc2\x9cF\xc3\xb9 j\xc2\xa8P\x19.\xc2\x80\x02M\xc3\xa9\x03.\xc2\x80\x02}q\x00(X\x10\x00\x00\x00protocol_versionq\x01M\xc3\xa9\x03X\x0d\x00\x00\x00little_endianq\x02\xc2\x88X\x0a\x00\x00\x00type_sizesq\x03}q\x04(X\x05\x00\x00\x00shortq\x05K\x02X\x03\x00\x00\x00intq\x06K\x04X\x04\x00\x00\x00longq\x07K\x04uu.\xc2\x80\x02(X\x07\x00\x00\x00storageq\x00ctorch\x0aFloatStorage\x0aq\x01X\x0e\x00\x00\x0094641233661088q\x02X\x03\x00\x00\x00cpuq\x03K\x04Ntq\x04Q.\xc2\x80\x02]q\x00X\x0e\x00\x00\x0094641233661088q\x01a.\x04\x00\x00\x00\x00\x00\x00\x00\x00\x00\xc2\x80?\x00\x00\x00@\x00\x00@@\x00\x00\xc2\x80@q\x05X\x06\x00\x00\x00latin1q\x06\x86q\x07Rq\x08\x85q\x09Rq\x0aK\x00K\x02K\x02\x86q\x0bK\x01K\x02\x86q\x0c\x89ccollections\x0aOrderedDict\x0aq\x0d)Rq\x0etq\x0fRq\x10X\x01\x00\x00\x00uq\x11h\x02(h\x03h\x04X\x1a\x01\x00\x00\xc2\x80\x02\xc2\x8a\x0al\xc3\xbc\xc2\x9cF\xc3\xb9 j\xc2\xa8P\x19.\xc2\x80\x02M\xc3\xa9\x03.\xc2\x80\x02}q\x00(X\x10\x00\x00\x00protocol_versionq\x01M\xc3\xa9\x03X\x0d\x00\x00\x00little_endianq\x02\xc2\x88X\x0a\x00\x00\x00type_sizesq\x03}q\x04(X\x05\x00\x00\x00shortq\x05K\x02X\x03\x00\x00\x00intq\x06K\x04X\x04\x00\x00\x00longq\x07K\x04uu.\xc2\x80\x02(X\x07\x00\x00\x00storageq\x00ctorch\x0aFloatStorage\x0aq\x01X\x0e\x00\x00\x0094641233661088q\x02X\x03\x00\x00\x00cpuq\x03K\x04Ntq\x04Q.\xc2\x80\x02]q\x00X\x0e\x00\x00\x0094641233661088q\x01a.\x04\x00\x00\x00\x00\x00\x00\x00\x00\x00\xc2\x80?\x00\x00\x00@\x00\x00@@\x00\x00\xc2\x80@q\x12h\x06\x86q\x13Rq\x14\x85q\x15Rq\x16K\x02K\x02\x85q\x17K\x01\x85q\x18\x89h\x0d)Rq\x19tq\x1aRq\x1bu.";

    fn values(pickle: &Pickle, id: Id) -> (Vec<usize>, Vec<f64>) {
        let array = pickle.numbers(id).unwrap().read().unwrap();
        let values = array.to::<f64>().unwrap().into_raw_vec_and_offset().0;
        (array.shape, values)
    }

    fn file(bytes: &[u8]) -> tempfile::NamedTempFile {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(bytes).unwrap();
        file
    }

    #[test]
    fn arrays_of_every_protocol_are_read_from_memory_and_from_a_file() {
        for bytes in PROTOCOLS {
            let file = file(bytes);
            for pickle in [
                Pickle::parse(bytes).unwrap(),
                Pickle::open(file.path()).unwrap(),
            ] {
                let array = pickle.get(pickle.root(), "a").unwrap();
                assert_eq!(values(&pickle, array), (vec![1, 3], vec![1.5, 2.0, 3.0]));
            }
        }
        let pickle = Pickle::parse(FORTRAN).unwrap();
        assert_eq!(
            values(&pickle, pickle.root()),
            (vec![2, 2], vec![1.0, 2.0, 3.0, 4.0])
        );
    }

    #[test]
    fn tensors_of_torchs_first_format_are_read_with_their_strides() {
        let file = file(TENSORS);
        for pickle in [
            Pickle::parse(TENSORS).unwrap(),
            Pickle::open(file.path()).unwrap(),
        ] {
            let get = |key: &str| values(&pickle, pickle.get(pickle.root(), key).unwrap());
            assert_eq!(get("t"), (vec![2, 2], vec![1.0, 3.0, 2.0, 4.0]));
            assert_eq!(get("u"), (vec![2], vec![3.0, 4.0]));
        }
    }

    #[test]
    fn long_arrays_stay_in_the_file_until_they_are_read_and_a_cut_file_says_where() {
        // Protocol 3 with an array of 1000 numbers in place of three.
        let numbers: Vec<u8> = (0..1000).flat_map(|k| (k as f32).to_le_bytes()).collect();
        let short = b"C\x0c\x00\x00\xc0?\x00\x00\x00@\x00\x00@@";
        let at = PROTOCOLS[1]
            .windows(short.len())
            .position(|w| w == short)
            .unwrap();
        let mut bytes = PROTOCOLS[1][..at].to_vec();
        bytes.push(b'B');
        bytes.extend(4000u32.to_le_bytes());
        bytes.extend(&numbers);
        bytes.extend(&PROTOCOLS[1][at + short.len()..]);
        let shape = b"K\x01K\x03\x86";
        let at = bytes.windows(shape.len()).position(|w| w == shape).unwrap();
        bytes.splice(at..at + shape.len(), *b"K\x01M\xe8\x03\x86");
        let whole = file(&bytes);
        let pickle = Pickle::open(whole.path()).unwrap();
        let array = pickle.get(pickle.root(), "a").unwrap();
        let stored = pickle.numbers(array).unwrap();
        assert!(matches!(stored.place, Place::File { length: 4000, .. }));
        let (shape, read) = values(&pickle, array);
        assert_eq!((shape, read[999]), (vec![1, 1000], 999.0));
        let cut = file(&bytes[..2000]);
        let error = Pickle::open(cut.path()).unwrap_err().to_string();
        assert!(
            error.contains("byte ") && error.contains("cut short"),
            "{error}"
        );
        let wrong = file(&[&bytes[..at], b"K\x02", &bytes[at + 2..]].concat());
        let pickle = Pickle::open(wrong.path()).unwrap();
        let error = pickle
            .numbers(pickle.get(pickle.root(), "a").unwrap())
            .unwrap_err();
        assert!(error.contains("[2, 1000]"), "{error}");
    }
}
