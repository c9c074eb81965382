//! Checkpoint files, good and bad: what is read, and what a bad file's message says.

use std::path::{Path, PathBuf};

use model_compiler::error::{Error, ErrorCode};
use model_compiler::import::checkpoint::{Checkpoint, DType, Format, TensorData, parse, read};
use safetensors::tensor::{Dtype, TensorView};
use tests::torch_file::{Container, LegacyHead, Py, Saved, Storage, pickle, zip_of};

/// Two tensors of an ordinary network.
fn small() -> Saved {
    Saved::state_dict(&[("conv1.weight", &[2, 1, 1, 2], &[1.0, -2.0, 3.5, 0.25]), ("conv1.bias", &[2], &[0.5, -0.5])])
}

fn safetensors_of(tensors: &[(&str, Dtype, Vec<usize>, &[u8])]) -> Vec<u8> {
    let views = tensors.iter().map(|(name, dtype, shape, bytes)| {
        (name.to_string(), TensorView::new(*dtype, shape.clone(), bytes).expect("shape and bytes agree"))
    });
    safetensors::serialize(views, None).expect("serializable")
}

/// A safetensors file of this header and as much data.
fn safetensors_raw(header: &str, data_bytes: usize) -> Vec<u8> {
    [(header.len() as u64).to_le_bytes().as_slice(), header.as_bytes(), &vec![0; data_bytes]].concat()
}

fn small_safetensors() -> Vec<u8> {
    let floats = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let (weight, bias) = (floats(&[1.0, -2.0, 3.5, 0.25]), floats(&[0.5, -0.5]));
    safetensors_of(&[
        ("conv1.weight", Dtype::F32, vec![2, 1, 1, 2], &weight),
        ("conv1.bias", Dtype::F32, vec![2], &bias),
    ])
}

fn floats(checkpoint: &Checkpoint, name: &str) -> Vec<f32> {
    checkpoint.get(name).and_then(|tensor| tensor.floats()).unwrap_or_else(|| panic!("no floats {name}")).to_vec()
}

fn names(checkpoint: &Checkpoint) -> Vec<&str> {
    checkpoint.tensors().iter().map(|tensor| tensor.name.as_str()).collect()
}

fn both(saved: &Saved) -> [Checkpoint; 2] {
    [parse(&saved.legacy()).expect("legacy"), parse(&saved.zip()).expect("zip")]
}

/// The error of a file, checked to be of `code`, to say all of `words` and to offer help.
#[track_caller]
fn assert_error(bytes: &[u8], code: ErrorCode, words: &[&str]) -> Error {
    let error = parse(bytes).expect_err("this file must be refused");
    let text = error.to_string();
    assert_eq!(error.code, code, "{text}");
    words.iter().for_each(|word| assert!(text.contains(word), "{text:?} does not say {word:?}"));
    assert!(!error.help.is_empty() && !error.location.is_empty(), "{text:?} lacks help or place");
    error
}

/// The zip archive of `saved` with one entry edited.
fn zip_with(saved: &Saved, edit: impl FnOnce(&mut Vec<(String, Vec<u8>)>)) -> Vec<u8> {
    let mut entries = saved.entries();
    edit(&mut entries);
    zip_of(&entries, zip::CompressionMethod::Stored)
}

// What is read.

#[test]
fn all_formats_give_the_same_tensors() {
    let files = [
        (small().legacy(), Format::TorchLegacy),
        (small().zip(), Format::TorchZip),
        (zip_of(&small().entries(), zip::CompressionMethod::Deflated), Format::TorchZip),
        (small_safetensors(), Format::Safetensors),
    ];
    for (bytes, format) in files {
        let checkpoint = parse(&bytes).unwrap_or_else(|error| panic!("{format:?}: {error}"));
        assert_eq!(checkpoint.format(), format);
        assert_eq!(floats(&checkpoint, "conv1.weight"), [1.0, -2.0, 3.5, 0.25]);
        assert_eq!(floats(&checkpoint, "conv1.bias"), [0.5, -0.5]);
        assert_eq!(checkpoint.get("conv1.weight").map(|tensor| tensor.shape.clone()), Some(vec![2, 1, 1, 2]));
        // The safetensors writer sorts by name.
        let order = if format == Format::Safetensors { [1, 0] } else { [0, 1] };
        assert_eq!(names(&checkpoint), order.map(|at| ["conv1.weight", "conv1.bias"][at]), "{format:?}");
        assert!(checkpoint.get("conv1").is_none());
        assert_eq!(checkpoint.non_finite().count(), 0);
    }
}

#[test]
fn the_digest_is_that_of_the_file() {
    // SHA-256 of this header and data, computed with another program.
    let bytes = safetensors_raw(r#"{"a":{"dtype":"U8","shape":[1],"data_offsets":[0,1]}}"#, 1);
    let hex: String = parse(&bytes).unwrap().sha256().iter().map(|byte| format!("{byte:02x}")).collect();
    assert_eq!(hex, "d0917aa2bb9b28b6a706d7ca3e8fe995dfd0a70be12b7237324b0a98c79dabc9");
}

#[test]
fn every_element_type_is_converted() {
    let half = [0x00, 0x3c, 0x00, 0xc1];
    let saved = Saved::of_types(&[
        ("f64", "DoubleStorage", &[1], 0.1f64.to_le_bytes().to_vec()),
        ("f16", "HalfStorage", &[2], half.to_vec()),
        ("bf16", "BFloat16Storage", &[1], vec![0x20, 0xc0]),
        ("num_batches_tracked", "LongStorage", &[], 1_234_567_890_123i64.to_le_bytes().to_vec()),
        ("i32", "IntStorage", &[1], (-7i32).to_le_bytes().to_vec()),
        ("i16", "ShortStorage", &[1], (-7i16).to_le_bytes().to_vec()),
        ("i8", "CharStorage", &[1], vec![0xf9]),
        ("u8", "ByteStorage", &[1], vec![0xf9]),
        ("bool", "BoolStorage", &[2], vec![0, 1]),
    ]);
    for checkpoint in both(&saved) {
        assert_eq!(floats(&checkpoint, "f64"), [0.1]);
        assert_eq!(floats(&checkpoint, "f16"), [1.0, -2.5]);
        assert_eq!(floats(&checkpoint, "bf16"), [-2.5]);
        let integers = |name| checkpoint.get(name).and_then(|tensor| tensor.integers()).map(<[i64]>::to_vec);
        assert_eq!(integers("num_batches_tracked"), Some(vec![1_234_567_890_123]));
        assert_eq!(integers("i32"), Some(vec![-7]));
        assert_eq!(integers("i16"), Some(vec![-7]));
        assert_eq!(integers("i8"), Some(vec![-7]));
        assert_eq!(integers("u8"), Some(vec![249]));
        assert_eq!(integers("bool"), Some(vec![0, 1]));
        assert_eq!(checkpoint.get("f16").map(|tensor| tensor.dtype), Some(DType::F16));
    }
}

#[test]
fn shared_and_strided_storages_are_gathered() {
    let saved = Saved::counting(12, |storage| {
        Py::StateDict(vec![
            (Py::str("whole"), Py::tensor(storage.clone(), 0, &[3, 4], &[4, 1])),
            (Py::str("transposed"), Py::tensor(storage.clone(), 0, &[4, 3], &[1, 4])),
            (Py::str("column"), Py::tensor(storage.clone(), 2, &[3], &[4])),
            (Py::str("expanded"), Py::tensor(storage, 11, &[2, 2], &[0, 0])),
        ])
    });
    for checkpoint in both(&saved) {
        assert_eq!(floats(&checkpoint, "whole"), (0..12).map(|value| value as f32).collect::<Vec<_>>());
        assert_eq!(floats(&checkpoint, "transposed")[..6], [0.0, 4.0, 8.0, 1.0, 5.0, 9.0]);
        assert_eq!(floats(&checkpoint, "column"), [2.0, 6.0, 10.0]);
        assert_eq!(floats(&checkpoint, "expanded"), [11.0; 4]);
    }
}

#[test]
fn legacy_views_begin_at_their_offset() {
    let saved = Saved::counting(6, |_| {
        let view = Py::Storage("0".to_owned(), "FloatStorage", 6, Some((2, 3)));
        Py::StateDict(vec![(Py::str("a"), Py::tensor(view, 1, &[2], &[1]))])
    });
    assert_eq!(floats(&parse(&saved.legacy()).unwrap(), "a"), [3.0, 4.0]);
    let outside = Saved::counting(6, |_| {
        let view = Py::Storage("0".to_owned(), "FloatStorage", 6, Some((2, 5)));
        Py::StateDict(vec![(Py::str("a"), Py::tensor(view, 0, &[1], &[1]))])
    });
    assert_error(&outside.legacy(), ErrorCode::Malformed, &["BINPERSID", "found a view of 5 elements at 2"]);
}

#[test]
fn parameters_and_old_tensors_are_read() {
    let saved = Saved::counting(2, |storage| {
        let tensor = Py::tensor(storage.clone(), 0, &[2], &[1]);
        let hooks = Py::Call("collections", "OrderedDict", vec![]);
        let parameter = Py::Call("torch._utils", "_rebuild_parameter", vec![tensor, Py::Bool(true), hooks]);
        let shape = Py::Call("torch", "Size", vec![Py::ints(&[2])]);
        let old = Py::Call("torch._utils", "_rebuild_tensor", vec![storage, Py::Int(0), shape, Py::ints(&[1])]);
        Py::dict([("parameter", parameter), ("old", old)])
    });
    for checkpoint in both(&saved) {
        assert_eq!(floats(&checkpoint, "parameter"), [0.0, 1.0]);
        assert_eq!(floats(&checkpoint, "old"), [0.0, 1.0]);
    }
}

#[test]
fn wrappers_and_what_lies_beside_are_passed_over() {
    let lightning = small().wrap(|weights| {
        Py::dict([
            ("epoch", Py::Int(99)),
            ("pytorch-lightning_version", Py::str("1.2")),
            (
                "callbacks",
                Py::Dict(vec![(
                    Py::Global("pytorch_lightning.callbacks.model_checkpoint", "ModelCheckpoint"),
                    Py::dict([("best", Py::Float(0.5))]),
                )]),
            ),
            ("optimizer_states", Py::List(vec![Py::dict([("lr", Py::Float(1e-4)), ("none", Py::None)])])),
            ("state_dict", weights),
            (
                "hyper_parameters",
                Py::dict([
                    ("hack", Py::Bool(true)),
                    ("dataset_dir", Py::Call("pathlib", "PosixPath", vec![Py::str("/"), Py::str("data")])),
                    ("more", Py::Call("argparse", "Namespace", vec![])),
                ]),
            ),
        ])
    });
    let wrap = |key| small().wrap(|weights| Py::dict([("best_prec1", Py::Float(91.8)), (key, weights)]));
    let twice = small().wrap(|weights| Py::dict([("model", Py::dict([("state_dict", weights)]))]));
    for saved in [lightning, wrap("model"), wrap("net"), wrap("student_weights"), twice] {
        for checkpoint in both(&saved) {
            assert_eq!(names(&checkpoint), ["conv1.weight", "conv1.bias"]);
        }
    }
}

#[test]
fn entries_that_are_no_tensors_are_listed() {
    let saved = Saved::counting(1, |storage| {
        Py::dict([("a", Py::tensor(storage, 0, &[1], &[1])), ("epoch", Py::Int(3)), ("note", Py::str("x"))])
    });
    assert_eq!(parse(&saved.zip()).unwrap().skipped(), ["epoch", "note"]);
    let wrapped = saved.wrap(|weights| {
        Py::Dict(vec![(Py::str("lr"), Py::Float(0.1)), (Py::str("net"), weights), (Py::Int(0), Py::None)])
    });
    assert_eq!(parse(&wrapped.legacy()).unwrap().skipped(), ["lr", "(an int as a name)", "epoch", "note"]);
}

#[test]
fn the_data_parallel_prefix_is_removed_only_from_all() {
    let all = Saved::state_dict(&[("module.a", &[1], &[1.0]), ("module.b", &[1], &[2.0])]);
    let some = Saved::state_dict(&[("module.a", &[1], &[1.0]), ("b", &[1], &[2.0])]);
    for (all, some) in both(&all).iter().zip(&both(&some)) {
        assert_eq!(names(all), ["a", "b"]);
        assert_eq!(names(some), ["module.a", "b"]);
        assert_eq!((floats(all, "b"), floats(some, "b")), (vec![2.0], vec![2.0]));
    }
}

#[test]
fn non_finite_values_are_read_and_reported() {
    let saved = Saved::state_dict(&[
        ("good", &[1], &[1.0]),
        ("bad", &[2, 3], &[0.0, 1.0, 2.0, 3.0, f32::NEG_INFINITY, f32::NAN]),
    ]);
    for checkpoint in both(&saved) {
        let bad: Vec<_> =
            checkpoint.non_finite().map(|tensor| (tensor.name.as_str(), tensor.first_non_finite())).collect();
        assert_eq!(bad, [("bad", Some((vec![1, 1], f32::NEG_INFINITY)))]);
    }
}

#[test]
fn tensors_without_elements_are_read() {
    let saved = Saved::state_dict(&[("empty", &[0, 3], &[]), ("scalar", &[], &[2.0])]);
    for checkpoint in both(&saved) {
        assert_eq!(checkpoint.get("empty").map(|tensor| tensor.data.clone()), Some(TensorData::Float(vec![])));
        assert_eq!(floats(&checkpoint, "scalar"), [2.0]);
    }
}

#[test]
fn a_published_checkpoint_is_read() {
    let Some(path) = shared_file("data/models/resnet20-12fca82f.th") else { return };
    let checkpoint = read(&path).unwrap_or_else(|error| panic!("{error}"));
    assert_eq!(checkpoint.format(), Format::TorchLegacy);
    // 19 convolutions, 19 normalizations of four tensors, a classifier of two: saved from DataParallel, torch before
    // 0.4.
    assert_eq!(checkpoint.tensors().len(), 19 + 19 * 4 + 2);
    let shape = |name| checkpoint.get(name).map(|tensor| tensor.shape.clone());
    assert_eq!(shape("conv1.weight"), Some(vec![16, 3, 3, 3]));
    assert_eq!(shape("layer3.2.bn2.running_var"), Some(vec![64]));
    assert_eq!(shape("linear.weight"), Some(vec![10, 64]));
    assert_eq!(checkpoint.non_finite().count(), 0);
    let variances = floats(&checkpoint, "layer3.2.bn2.running_var");
    assert!(variances.iter().all(|&variance| variance > 0.0), "variances are positive: {variances:?}");
}

/// A file of the shared data, where it is there.
fn shared_file(name: &str) -> Option<PathBuf> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared");
    let path = std::env::var_os("SHARED_DIR").map_or_else(beside, PathBuf::from).join(name);
    if !path.exists() {
        println!("not run: {name} is not in the shared data");
        return None;
    }
    Some(path)
}

// What is refused.

#[test]
fn messages_name_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("weights.pth");
    assert_eq!(read(&path).unwrap_err().code, ErrorCode::Io);
    std::fs::write(&path, b"<!DOCTYPE html>").unwrap();
    let text = read(&path).unwrap_err().to_string();
    assert!(text.starts_with(&format!("{}: byte 0: found a file that begins with", path.display())), "{text}");
}

#[test]
fn unknown_files_are_described() {
    assert_error(b"", ErrorCode::Malformed, &["found an empty file", "expected a torch zip archive"]);
    assert_error(b"\x89PNG\r\n\x1a\n", ErrorCode::Malformed, &["begins with \"\\x89PNG"]);
    assert_error(b"version https://git-lfs.github.com/spec/v1\n", ErrorCode::Malformed, &["git lfs pull"]);
}

#[test]
fn every_prefix_is_an_error() {
    for bytes in [small().legacy(), small().zip(), small_safetensors()] {
        for length in 0..bytes.len() {
            let error = parse(&bytes[..length]).expect_err("a prefix is not a file");
            assert_eq!(error.code, ErrorCode::Malformed, "{length} bytes: {error}");
        }
    }
}

#[test]
fn trailing_bytes_are_errors() {
    let longer = |mut bytes: Vec<u8>| {
        bytes.extend(b"more");
        bytes
    };
    assert_error(&longer(small().legacy()), ErrorCode::Malformed, &["found 4 bytes after the last storage"]);
    assert_error(&longer(small().zip()), ErrorCode::Malformed, &["found bytes after the zip archive"]);
    assert_error(&longer(small_safetensors()), ErrorCode::Malformed, &["found 28 bytes, expected 24"]);
    let program = zip_with(&small(), |entries| entries[0].1.extend(b"more"));
    assert_error(&program, ErrorCode::Malformed, &["model/data.pkl: byte", "found 4 bytes after the pickle"]);
}

#[test]
fn a_pickle_that_calls_a_function_is_refused_by_name() {
    let attack = small().wrap(|weights| {
        Py::dict([("state_dict", weights), ("x", Py::Call("os", "system", vec![Py::str("echo never")]))])
    });
    assert_error(&attack.legacy(), ErrorCode::Refused, &["\"os.system\"", "(GLOBAL)", "nothing was executed"]);
    assert_error(&attack.zip(), ErrorCode::Refused, &["model/data.pkl: byte", "\"os.system\""]);
    // Anywhere in a legacy stream, the first pickle included.
    assert_error(&pickle(&attack.root, Container::Legacy), ErrorCode::Refused, &["\"os.system\""]);
    let unknown = small().wrap(|_| Py::Call("my_project.model", "TransFuser", vec![]));
    assert_error(&unknown.zip(), ErrorCode::Refused, &["my_project.model.TransFuser", "state_dict()"]);
}

#[test]
fn claimed_sizes_are_checked_before_anything_is_allocated() {
    let storage = |elements| Py::Storage("0".to_owned(), "FloatStorage", elements, None);
    let claim = |elements: i64, shape: &[i64], strides: &[i64]| Saved {
        root: Py::StateDict(vec![(Py::str("a"), Py::tensor(storage(elements), 0, shape, strides))]),
        storages: vec![Storage { key: "0".to_owned(), elements, bytes: vec![0; 16] }],
    };
    let four_gigabytes = claim(1 << 30, &[1 << 30], &[1]);
    let expected = ["tensor \"a\"", "found shape [1073741824]", "4294967296 bytes"];
    assert_error(&four_gigabytes.zip(), ErrorCode::Malformed, &expected);
    let behind_a_small_tensor = claim(1 << 30, &[4], &[1]);
    let expected = "found 16 bytes before the end, expected 1073741824 elements of 4 bytes";
    for saved in [&four_gigabytes, &behind_a_small_tensor] {
        assert_error(&saved.legacy(), ErrorCode::Malformed, &["byte", "storage \"0\"", expected]);
    }
    let expected = "found 16 bytes, expected 1073741824 elements of 4 bytes";
    assert_error(&behind_a_small_tensor.zip(), ErrorCode::Malformed, &["tensor \"a\"", "model/data/0", expected]);
    // No storage is large, but one element seen through strides of zero is.
    let expanded = claim(4, &[1 << 20, 1 << 10], &[0, 0]);
    assert_error(&expanded.zip(), ErrorCode::Malformed, &["tensor \"a\"", "expected at most"]);
    let overflow = claim(4, &[1 << 40, 1 << 40], &[0, 0]);
    assert_error(&overflow.zip(), ErrorCode::Malformed, &["REDUCE", "whose element count overflows"]);
    let negative = claim(-4, &[1], &[1]);
    assert_error(&negative.zip(), ErrorCode::Malformed, &["found the number -4"]);
}

#[test]
fn views_outside_their_storage_are_refused() {
    let view = |offset, shape: &[i64], strides: &[i64]| {
        let (shape, strides) = (shape.to_vec(), strides.to_vec());
        Saved::counting(6, |storage| Py::StateDict(vec![(Py::str("a"), Py::tensor(storage, offset, &shape, &strides))]))
    };
    for saved in [view(1, &[6], &[1]), view(0, &[2, 3], &[4, 1]), view(0, &[2], &[i64::MAX])] {
        for bytes in [saved.legacy(), saved.zip()] {
            assert_error(&bytes, ErrorCode::Malformed, &["storage \"0\"", "found a view", "expected at most 6"]);
        }
    }
    assert_error(&view(0, &[2], &[-1]).zip(), ErrorCode::Malformed, &["found the number -1", "none below zero"]);
    assert_error(&view(0, &[2], &[1, 1]).zip(), ErrorCode::Malformed, &["found 1 extents and 2 strides"]);
    assert_error(&view(0, &[1; 33], &[1; 33]).zip(), ErrorCode::Malformed, &["length 33, expected at most 32"]);
}

/// A long name costs two bytes where the memo recalls it; as many copies of it would be a bomb.
#[test]
fn recalled_names_are_not_copied() {
    let name = [b"X\x00\x00\x10\x00".as_slice(), &vec![b'a'; 1 << 20], b"q\x01"].concat();
    let items = [b"}(".to_vec(), name, b"K\x00".to_vec(), b"h\x01K\x00".repeat(1 << 18), b"u".to_vec()].concat();
    let saved = Saved { root: Py::Raw(items), storages: vec![] };
    assert_error(&saved.legacy(), ErrorCode::Malformed, &["found twice"]);
}

#[test]
fn damaged_archives_are_described() {
    let missing = zip_with(&small(), |entries| entries.retain(|(name, _)| name != "model/data/1"));
    assert_error(&missing, ErrorCode::Malformed, &["tensor \"conv1.bias\"", "model/data/1", "found no such entry"]);
    let short = zip_with(&small(), |entries| entries[2].1.truncate(12));
    assert_error(&short, ErrorCode::Malformed, &["model/data/0", "found 12 bytes, expected 4 elements of 4 bytes"]);
    let big = zip_with(&small(), |entries| entries[1].1 = b"big".to_vec());
    assert_error(&big, ErrorCode::Unsupported, &["model/byteorder", "found \"big\", expected \"little\""]);
    let other = zip_of(&[("word/document.xml".to_owned(), vec![])], zip::CompressionMethod::Stored);
    assert_error(&other, ErrorCode::Malformed, &["found no data.pkl among 1 entries", "word/document.xml"]);
    let twice = zip_with(&small(), |entries| entries.push(("other/data.pkl".to_owned(), vec![])));
    assert_error(&twice, ErrorCode::Malformed, &["model/data.pkl and other/data.pkl"]);
    let script = zip_with(&small(), |entries| entries.push(("model/constants.pkl".to_owned(), vec![])));
    assert_error(&script, ErrorCode::Unsupported, &["TorchScript"]);
    let mut damaged = small().zip();
    let weights = 1.0f32.to_le_bytes();
    let at = damaged.windows(4).position(|window| window == weights).expect("the weights are stored");
    damaged[at] ^= 1;
    assert_error(&damaged, ErrorCode::Malformed, &["model/data/0", "checksum"]);
}

#[test]
fn a_decompression_bomb_is_refused() {
    let zeros = |bytes| (0..bytes).map(|_| 0u8).collect::<Vec<_>>();
    let bomb = |length: i64| {
        let storage = Py::Storage("0".to_owned(), "FloatStorage", length / 4, None);
        let root = Py::StateDict(vec![(Py::str("a"), Py::tensor(storage, 0, &[1], &[1]))]);
        let saved =
            Saved { root, storages: vec![Storage { key: "0".to_owned(), elements: length / 4, bytes: zeros(length) }] };
        zip_of(&saved.entries(), zip::CompressionMethod::Deflated)
    };
    assert!(parse(&bomb(1 << 20)).is_ok(), "a megabyte of zeros is no bomb");
    assert_error(&bomb(64 << 20), ErrorCode::Malformed, &["model/data/0", "found a claim of 67108864 bytes"]);
}

#[test]
fn damaged_legacy_streams_are_described() {
    let head = |edit: fn(&mut LegacyHead)| {
        let mut head = LegacyHead::default();
        edit(&mut head);
        small().legacy_with(&head)
    };
    assert_error(&head(|head| head.magic[0] = 0), ErrorCode::Malformed, &["0x1950a86a20f9469cfc6c"]);
    assert_error(&head(|head| head.protocol = 1002), ErrorCode::Unsupported, &["found torch protocol 1002"]);
    assert_error(&head(|head| head.little_endian = false), ErrorCode::Unsupported, &["big-endian"]);

    let mut count = small();
    count.storages[1].elements = 3;
    assert_error(&count.legacy(), ErrorCode::Malformed, &["storage \"1\"", "found a count of 3 elements, expected 2"]);
    let mut missing = small();
    missing.storages.pop();
    assert_error(&missing.legacy(), ErrorCode::Malformed, &["tensor \"conv1.bias\"", "no such key"]);
    let mut twice = small();
    twice.storages[1] = twice.storages[0].clone();
    assert_error(&twice.legacy(), ErrorCode::Malformed, &["storage \"0\"", "found twice"]);
    let mut unknown = small();
    unknown.storages[1].key = "7".to_owned();
    assert_error(&unknown.legacy(), ErrorCode::Malformed, &["list of storage keys", "found \"7\""]);
}

#[test]
fn files_without_weights_are_described() {
    let with = |root| Saved { root, storages: vec![] };
    let checks = [
        (Py::Int(7), "found an int, expected a dict of tensors"),
        (Py::dict([("epoch", Py::Int(7))]), "found a dict of {\"epoch\": an int}"),
        (Py::dict([("state_dict", Py::dict([]))]), "found a dict of {}"),
        // A dict that holds itself: stored in the memo, recalled as its own value.
        (Py::Raw(b"}q\x00X\x05\0\0\0modelh\x00s".to_vec()), "found more than 4 dicts around the weights"),
    ];
    for (root, expected) in checks {
        assert_error(&with(root.clone()).zip(), ErrorCode::Tensors, &["state dict", expected]);
        assert_error(&with(root).legacy(), ErrorCode::Tensors, &[expected]);
    }
    let empty = parse(&safetensors_raw("{}", 0)).unwrap_err();
    assert_eq!(empty.code, ErrorCode::Tensors, "{empty}");
}

#[test]
fn names_and_storages_must_agree() {
    let twice = Saved::counting(1, |storage| {
        let tensor = Py::tensor(storage, 0, &[1], &[1]);
        Py::StateDict(vec![(Py::str("a"), tensor.clone()), (Py::str("a"), tensor)])
    });
    assert_error(&twice.zip(), ErrorCode::Malformed, &["tensor \"a\"", "found twice"]);
    let types = Saved::counting(2, |storage| {
        let other = Py::Storage("0".to_owned(), "LongStorage", 1, None);
        let (a, b) = (Py::tensor(storage, 0, &[1], &[1]), Py::tensor(other, 0, &[1], &[1]));
        Py::StateDict(vec![(Py::str("a"), a), (Py::str("b"), b)])
    });
    for bytes in [types.zip(), types.legacy()] {
        assert_error(&bytes, ErrorCode::Malformed, &["tensor \"b\"", "1 × i64, expected 2 × f32 as in tensor \"a\""]);
    }
    let complex = Saved::of_types(&[("a", "ComplexFloatStorage", &[1], vec![0; 8])]);
    assert_error(&complex.zip(), ErrorCode::Unsupported, &["torch.ComplexFloatStorage"]);
}

#[test]
fn damaged_safetensors_are_described() {
    let header = |offsets: [&str; 2]| {
        let entry = |name, offsets| format!(r#""{name}":{{"dtype":"U8","shape":[4],"data_offsets":{offsets}}}"#);
        format!("{{{},{}}}", entry("a", offsets[0]), entry("b", offsets[1]))
    };
    assert!(parse(&safetensors_raw(&header(["[0,4]", "[4,8]"]), 8)).is_ok());
    let expected = "data_offsets follow each other without gap or overlap";
    assert_error(&safetensors_raw(&header(["[0,4]", "[2,6]"]), 6), ErrorCode::Malformed, &["header", "`b`", expected]);
    assert_error(
        &safetensors_raw(&header(["[0,4]", "[6,10]"]), 10),
        ErrorCode::Malformed,
        &["header", "`b`", expected],
    );
    assert_error(&safetensors_raw(&header(["[0,4]", "[4,9]"]), 9), ErrorCode::Malformed, &["header", expected]);
    assert_error(
        &safetensors_raw(&header(["[0,4]", "[4,8]"]), 7),
        ErrorCode::Malformed,
        &["found 7 bytes, expected 8"],
    );
    assert_error(&safetensors_raw("{nonsense", 0), ErrorCode::Malformed, &["header", "line 1 column 2"]);
    let mut truncated = small_safetensors();
    truncated[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    assert_error(&truncated, ErrorCode::Malformed, &["header", "expected 18446744073709551615 of header"]);
    let half = r#"{"a":{"dtype":"F8_E4M3","shape":[4],"data_offsets":[0,4]}}"#;
    assert_error(&safetensors_raw(half, 4), ErrorCode::Unsupported, &["tensor \"a\"", "F8_E4M3", "float32"]);
}

#[test]
fn safetensors_sizes_that_wrap_are_refused() {
    // Eight tensors of 2^61 − 1 bytes end eight bytes below 2^64: header and data together wrap to a small number.
    let size = (1u64 << 61) - 1;
    let tensor = |at: u64| {
        format!(r#""{at}":{{"dtype":"U8","shape":[{size}],"data_offsets":[{},{}]}}"#, at * size, (at + 1) * size)
    };
    let header = format!("{{{}}}", (0..8).map(tensor).collect::<Vec<_>>().join(","));
    assert_error(&safetensors_raw(&header, 0), ErrorCode::Malformed, &["found 0 bytes", "18446744073709551608"]);
}

// Any bytes.

/// A file of each format, with what the readers branch on: views, wrappers, views of views, element types.
fn seeds() -> [(&'static str, Vec<u8>); 3] {
    let saved = Saved::counting(6, |storage| {
        let view = Py::Storage("0".to_owned(), "FloatStorage", 6, Some((1, 4)));
        let weights = Py::StateDict(vec![
            (Py::str("module.a"), Py::tensor(storage, 0, &[2, 3], &[1, 2])),
            (Py::str("module.b"), Py::tensor(view, 0, &[2, 2], &[2, 1])),
        ]);
        Py::dict([("epoch", Py::Int(1)), ("state_dict", weights), ("lr", Py::Float(0.5))])
    });
    [("legacy.pth", saved.legacy()), ("zip.pth", saved.zip()), ("small.safetensors", small_safetensors())]
}

/// The fuzzer starts from the files these tests write.
#[test]
fn stored_fuzz_seeds_are_current() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/seeds/checkpoint");
    for (name, bytes) in seeds() {
        let path = folder.join(name);
        if std::env::var_os("UPDATE_SEEDS").is_some() {
            std::fs::create_dir_all(&folder).and_then(|()| std::fs::write(&path, &bytes)).expect("writable");
        }
        let stored = std::fs::read(&path).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert!(stored == bytes, "{name} differs: run this test once with UPDATE_SEEDS=1");
    }
}

/// Random numbers (splitmix64).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }

    fn below(&mut self, bound: usize) -> usize {
        (self.next() % bound.max(1) as u64) as usize
    }

    /// One edit: a bit, a byte, a number at its limits, or a piece cut, repeated or moved.
    fn edit(&mut self, bytes: &mut Vec<u8>) {
        if bytes.is_empty() {
            return;
        }
        let at = self.below(bytes.len());
        let end = bytes.len().min(at + 1 + self.below(12));
        let piece = bytes[at..end].to_vec();
        match self.below(7) {
            0 => bytes[at] ^= 1 << self.below(8),
            1 => bytes[at] = self.next() as u8,
            2 => bytes[at..end].fill([0, 0xff, 0x7f, 0x80][self.below(4)]),
            3 => drop(bytes.drain(at..end)),
            4 => drop(bytes.splice(at..at, piece)),
            5 => bytes.truncate(at),
            _ => {
                let to = self.below(bytes.len());
                bytes.splice(to..to, piece);
            }
        }
    }
}

#[test]
fn no_mutated_file_panics() {
    const CASES: u64 = 30_000;
    let seeds = seeds();
    let program = pickle(&small().root, Container::Zip);
    let (mut read, mut refused) = (0, 0);
    for case in 0..CASES {
        let mut random = Random(case);
        let mut bytes = match random.below(4) {
            // Behind the archive's checksums, which nearly every edit of the archive itself trips over.
            3 => program.clone(),
            format => seeds[format].1.clone(),
        };
        let is_program = bytes == program;
        for _ in 0..=random.below(4) {
            random.edit(&mut bytes);
        }
        if is_program {
            bytes = zip_with(&small(), |entries| entries[0].1 = bytes);
        }
        match std::panic::catch_unwind(|| parse(&bytes)) {
            Err(_) => panic!("case {case} panics: {}", bytes.escape_ascii()),
            Ok(Err(error)) => {
                refused += 1;
                assert!(!error.message.is_empty(), "case {case}");
            }
            Ok(Ok(checkpoint)) => {
                read += 1;
                for tensor in checkpoint.tensors() {
                    assert_eq!(tensor.data.len(), tensor.shape.iter().product::<usize>(), "case {case}: {tensor:?}");
                }
            }
        }
    }
    // Edits of weights and names are no errors, so a share of the files must still be read.
    println!("{read} read, {refused} refused");
    assert!(read > CASES / 100 && refused > CASES / 2, "{read} read, {refused} refused");
}
