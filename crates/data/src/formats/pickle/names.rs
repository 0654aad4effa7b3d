//! What may be built: the allow-list of names. It holds those that `torch.load(weights_only=True)` of torch 2.15 accepts, NumPy's
//! numbers and arrays, plain containers, `argparse.Namespace`, and the classes of TorchScript.

use super::machine::Machine;
use super::{Global, MAX_GLOBAL, PickleError, Scalar};

/// Names of torch that are values and describe nothing that is read: types of few bits, ways to quantise, types of tensors.
const TORCH_NAMES: [&str; 45] = [
    "BFloat16Tensor",
    "BoolTensor",
    "ByteTensor",
    "CharTensor",
    "DoubleTensor",
    "FloatTensor",
    "HalfTensor",
    "IntTensor",
    "LongTensor",
    "ShortTensor",
    "TypedStorage",
    "bcomplex32",
    "bits16",
    "bits1x8",
    "bits2x4",
    "bits4x2",
    "bits8",
    "float4_e2m1fn_x2",
    "int1",
    "int2",
    "int3",
    "int4",
    "int5",
    "int6",
    "int7",
    "per_channel_affine",
    "per_channel_affine_float_qparams",
    "per_channel_symmetric",
    "per_tensor_affine",
    "per_tensor_symmetric",
    "quint2x4",
    "quint4x2",
    "strided",
    "sparse_coo",
    "sparse_csr",
    "sparse_csc",
    "sparse_bsr",
    "sparse_bsc",
    "uint1",
    "uint2",
    "uint3",
    "uint4",
    "uint5",
    "uint6",
    "uint7",
];

impl Machine<'_> {
    /// The allow-list.
    pub(super) fn global(&self, module: &str, name: &str) -> Result<Global, PickleError> {
        let length = module.len() + name.len();
        if length > MAX_GLOBAL {
            return self.refuse(format!("a global whose name has {length} bytes"));
        }
        Ok(match (module, name) {
            ("collections", "OrderedDict" | "Counter") => Global::Dictionary,
            ("collections", "defaultdict") => Global::DefaultDict,
            ("builtins" | "__builtin__", name) => match name {
                "dict" => Global::Dictionary,
                "list" | "tuple" | "set" | "frozenset" => Global::Container,
                "bytes" | "bytearray" => Global::Bytes,
                "complex" => Global::Complex,
                "int" | "long" => Global::Type("int"),
                "float" => Global::Type("float"),
                "bool" => Global::Type("bool"),
                "str" | "unicode" => Global::Type("str"),
                "object" => Global::Type("object"),
                _ => return self.forbidden(module, name),
            },
            ("copyreg" | "copy_reg", "_reconstructor") => Global::Reconstruct,
            ("argparse", "Namespace") => Global::Namespace,
            ("torch._utils", name) => match name {
                "_rebuild_tensor" | "_rebuild_tensor_v2" | "_rebuild_qtensor" => {
                    Global::RebuildTensor
                }
                "_rebuild_tensor_v3" => Global::RebuildTyped,
                "_rebuild_parameter" | "_rebuild_parameter_with_state" => Global::Parameter,
                "_rebuild_sparse_tensor" | "_rebuild_sparse_csr_tensor" => {
                    Global::RebuildOther("a sparse tensor")
                }
                "_rebuild_meta_tensor_no_storage" => {
                    Global::RebuildOther("a tensor without values (device `meta`)")
                }
                "_rebuild_nested_tensor" => Global::RebuildOther("a nested tensor"),
                "_rebuild_wrapper_subclass" => Global::RebuildOther("a wrapped tensor"),
                "_rebuild_device_tensor_from_numpy" | "_rebuild_device_tensor_from_cpu_tensor" => {
                    Global::RebuildOther("a tensor of another device")
                }
                _ => return self.forbidden(module, name),
            },
            ("torch._tensor", "_rebuild_from_type_v2" | "_rebuild_from_type") => {
                Global::RebuildFromType
            }
            ("torch.nn.parameter" | "torch.nn", "Parameter" | "Buffer") => Global::Parameter,
            ("torch.storage", "_load_from_bytes") => Global::StorageFromBytes,
            ("scipy.sparse.csc" | "scipy.sparse._csc", "csc_matrix") => {
                Global::Script("scipy.sparse.csc_matrix".into())
            }
            ("scipy.sparse.csr" | "scipy.sparse._csr", "csr_matrix") => {
                Global::Script("scipy.sparse.csr_matrix".into())
            }
            ("torch.serialization", "_get_layout") => Global::Layout,
            ("numpy.core.multiarray" | "numpy._core.multiarray", "scalar") => Global::NumpyScalar,
            ("numpy.core.multiarray" | "numpy._core.multiarray", "_reconstruct") => {
                Global::NumpyReconstruct
            }
            ("numpy.core.numeric" | "numpy._core.numeric", "_frombuffer") => {
                Global::NumpyFromBuffer
            }
            ("numpy", "dtype") => Global::NumpyDtype,
            ("numpy", "ndarray") => Global::NumpyArray,
            ("_codecs", "encode") => Global::Encode,
            (
                "torch.jit._pickle",
                "build_intlist" | "build_doublelist" | "build_boollist" | "build_tensorlist",
            ) => Global::Container,
            (
                "torch" | "torch.cuda" | "torch.storage" | "torch.sparse" | "torch.cuda.sparse",
                name,
            ) => {
                let inert = TORCH_NAMES.into_iter().find(|known| *known == name);
                let of_storage = Scalar::of_storage(name);
                match (name, of_storage, Scalar::of_torch(name), inert) {
                    ("Size", ..) if module == "torch" => Global::Container,
                    ("device", ..) if module == "torch" => Global::Device,
                    ("Tensor", ..) if module == "torch" => Global::Tensor,
                    ("UntypedStorage", ..) => Global::StorageType(Scalar::U8),
                    ("QUInt4x2Storage" | "QUInt2x4Storage", ..) => Global::PackedStorage,
                    (_, Some(scalar), ..) => Global::StorageType(scalar),
                    (_, _, Some(scalar), _) if module == "torch" => Global::TorchType(scalar),
                    (_, _, _, Some(name)) => Global::Type(name),
                    _ => return self.forbidden(module, name),
                }
            }
            // What chumpy computes is not asked for: its objects are the dictionaries that they were given.
            (module, name)
                if module == "__torch__"
                    || module.starts_with("__torch__.")
                    || module.starts_with("chumpy.") =>
            {
                Global::Script(format!("{module}.{name}").into())
            }
            _ => return self.forbidden(module, name),
        })
    }

    fn forbidden<T>(&self, module: &str, name: &str) -> Result<T, PickleError> {
        self.refuse(format!(
            "it wants to call `{module}.{name}`, which no checkpoint of a model needs; nothing was executed"
        ))
    }
}
