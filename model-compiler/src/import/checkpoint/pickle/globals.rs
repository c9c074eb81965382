//! The allow-list: every Python name a pickle may mention, and what it becomes here. Nothing is ever called.

use super::super::DType;

/// An allowed Python name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Global {
    /// `collections.OrderedDict`: becomes a dict.
    OrderedDict,
    /// `torch._utils._rebuild_tensor` and `_rebuild_tensor_v2`: a view of a storage.
    RebuildTensor,
    /// `torch._utils._rebuild_parameter`: its first argument, a tensor.
    RebuildParameter,
    /// `torch.Size`: its argument, a tuple.
    Size,
    /// A storage class: the type of its elements.
    Storage(DType),
    /// Found beside the weights in training checkpoints; becomes an empty value whatever is done with it.
    Inert,
}

/// Names that training frameworks put beside the weights.
const INERT: [(&str, &str); 26] = [
    ("__builtin__", "dict"),
    ("__builtin__", "frozenset"),
    ("__builtin__", "list"),
    ("__builtin__", "set"),
    ("_codecs", "encode"),
    ("argparse", "Namespace"),
    ("builtins", "dict"),
    ("builtins", "frozenset"),
    ("builtins", "list"),
    ("builtins", "set"),
    ("collections", "Counter"),
    ("collections", "defaultdict"),
    ("numpy", "dtype"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy.core.multiarray", "scalar"),
    ("pathlib", "PosixPath"),
    ("pathlib", "WindowsPath"),
    ("pytorch_lightning.callbacks.early_stopping", "EarlyStopping"),
    ("pytorch_lightning.callbacks.model_checkpoint", "ModelCheckpoint"),
    ("pytorch_lightning.utilities.parsing", "AttributeDict"),
    ("torch", "bfloat16"),
    ("torch", "device"),
    ("torch", "float16"),
    ("torch", "float32"),
    ("torch", "float64"),
    ("torch", "int64"),
];

/// The allowed global of this name; `None` means refuse.
pub fn lookup(module: &str, name: &str) -> Option<Global> {
    match (module, name) {
        ("collections", "OrderedDict") => Some(Global::OrderedDict),
        ("torch._utils", "_rebuild_tensor" | "_rebuild_tensor_v2") => Some(Global::RebuildTensor),
        ("torch._utils", "_rebuild_parameter") => Some(Global::RebuildParameter),
        ("torch", "Size") => Some(Global::Size),
        ("torch", storage) if storage.ends_with("Storage") => storage_dtype(storage).map(Global::Storage),
        _ => INERT.contains(&(module, name)).then_some(Global::Inert),
    }
}

fn storage_dtype(class: &str) -> Option<DType> {
    Some(match class {
        "DoubleStorage" => DType::F64,
        "FloatStorage" => DType::F32,
        "HalfStorage" => DType::F16,
        "BFloat16Storage" => DType::BF16,
        "LongStorage" => DType::I64,
        "IntStorage" => DType::I32,
        "ShortStorage" => DType::I16,
        "CharStorage" => DType::I8,
        "ByteStorage" => DType::U8,
        "BoolStorage" => DType::Bool,
        _ => return None,
    })
}

/// Whether a refused name is a storage class of an element type that is not read (complex, quantized).
pub fn is_unread_storage(module: &str, name: &str) -> bool {
    module == "torch" && name.ends_with("Storage") && storage_dtype(name).is_none()
}
