//! Programs of a few bytes, written by hand.

use super::opcode::*;
use super::*;

fn load(bytes: &[u8]) -> Result<Pickle<'_>> {
    Pickle::load(Source { bytes, start: 0, file: "data.pkl" })
}

/// The error of a program, checked to be of `code` and to say all of `words`.
fn assert_refused(program: &[u8], code: ErrorCode, words: &[&str]) {
    let error = load(program).expect_err("this program must be refused");
    assert_eq!(error.code, code, "{error}");
    let text = error.to_string();
    words.iter().for_each(|word| assert!(text.contains(word), "{text:?} does not say {word:?}"));
}

/// The pickle of `count` opcodes `opcode`, behind a header.
fn repeated(opcode: u8, count: usize) -> Vec<u8> {
    [b"\x80\x02".to_vec(), vec![opcode; count], b".".to_vec()].concat()
}

#[test]
fn plain_values_are_read() {
    assert_eq!(load(b"\x80\x02N.").unwrap().root(), Value::None);
    assert_eq!(load(b"\x80\x02\x88.").unwrap().root(), Value::Bool(true));
    assert_eq!(load(b"\x80\x02J\xfe\xff\xff\xff.").unwrap().root(), Value::Int(-2));
    assert_eq!(load(b"\x80\x02M\xe9\x03.").unwrap().root(), Value::Int(1001));
    assert_eq!(load(b"\x80\x02\x8a\x02\x00\xff.").unwrap().root(), Value::Int(-256));
    assert_eq!(load(b"\x80\x02\x8a\x00.").unwrap().root(), Value::Int(0));
    let text = load(b"\x80\x04\x95\x05\0\0\0\0\0\0\0\x8c\x02ab\x94.").unwrap();
    assert_eq!(text.text(text.root()), Some("ab"));
    assert_eq!(text.end, 17);
}

#[test]
fn a_dict_may_hold_itself() {
    let pickle = load(b"\x80\x02}q\x00X\x01\0\0\0ah\x00s.").unwrap();
    let Some(Object::Dict(items)) = pickle.object(pickle.root()) else { panic!("not a dict") };
    assert_eq!(items[0].1, pickle.root());
}

#[test]
fn ordered_dicts_of_both_pythons_are_read() {
    let python3 = b"\x80\x02ccollections\nOrderedDict\n)R(X\x01\0\0\0aK\x01u}X\x01\0\0\0mNsb.";
    let python2 = b"\x80\x02ccollections\nOrderedDict\n](](U\x01aK\x01ee\x85R.";
    for program in [python3.as_slice(), python2] {
        let pickle = load(program).unwrap();
        let Some(Object::Dict(items)) = pickle.object(pickle.root()) else { panic!("not a dict") };
        assert_eq!((pickle.text(items[0].0), items[0].1, items.len()), (Some("a"), Value::Int(1), 1));
    }
}

#[test]
fn calls_are_refused_by_name_and_byte() {
    let system = b"\x80\x02cos\nsystem\nX\x02\0\0\0ls\x85R.";
    assert_refused(system, ErrorCode::Refused, &["data.pkl: byte 2 (GLOBAL)", "\"os.system\"", "nothing was executed"]);
    let stacked = b"\x80\x04\x8c\x08builtins\x8c\x04eval\x93.";
    assert_refused(stacked, ErrorCode::Refused, &["byte 18 (STACK_GLOBAL)", "\"builtins.eval\""]);
    // Attributes of an allowed module are not allowed with it.
    assert_refused(b"\x80\x02ctorch\nload\n.", ErrorCode::Refused, &["\"torch.load\""]);
    assert_refused(b"\x80\x02ctorch._utils\n_rebuild_qtensor\n.", ErrorCode::Refused, &["_rebuild_qtensor"]);
    for (program, name) in [(b"\x80\x02(ios\nsystem\n.".as_slice(), "INST"), (b"\x80\x02(o.", "OBJ")] {
        assert_refused(program, ErrorCode::Refused, &[name]);
    }
    assert_refused(b"\x80\x02\x82\x01.", ErrorCode::Refused, &["EXT1"]);
}

#[test]
fn only_globals_are_constructed() {
    assert_refused(
        b"\x80\x02X\x01\0\0\0f)R.",
        ErrorCode::Malformed,
        &["REDUCE", "found a string", "expected a global"],
    );
    assert_refused(b"\x80\x02ctorch\nFloatStorage\n)R.", ErrorCode::Malformed, &["Storage(F32) with 0 arguments"]);
    assert_refused(
        b"\x80\x02ctorch._utils\n_rebuild_parameter\nNNN\x87R.",
        ErrorCode::Malformed,
        &["expected a tensor"],
    );
    let inert = load(b"\x80\x02cargparse\nNamespace\n)\x81}X\x01\0\0\0aK\x01sb.").unwrap();
    assert!(matches!(inert.object(inert.root()), Some(Object::Opaque)));
}

#[test]
fn element_types_that_are_not_read_are_named() {
    let words = ["torch.ComplexFloatStorage", "expected a float, integer or bool storage"];
    assert_refused(b"\x80\x02ctorch\nComplexFloatStorage\n.", ErrorCode::Unsupported, &words);
}

#[test]
fn the_stack_cannot_underflow() {
    for opcode in [POP, DUP, TUPLE, TUPLE1, APPEND, APPENDS, SETITEM, SETITEMS, REDUCE, BUILD, BINPERSID, STOP] {
        assert_refused(&[PROTO, 2, opcode, STOP], ErrorCode::Malformed, &["byte 2", opcode::name(opcode), "expected"]);
    }
    // Values below an open mark are out of reach.
    assert_refused(b"\x80\x02NN(\x86.", ErrorCode::Malformed, &["found 0 values", "expected 2"]);
}

#[test]
fn bounds_hold() {
    assert_refused(&repeated(MARK, 100_000), ErrorCode::Malformed, &["nested marks", "1000"]);
    assert_refused(&repeated(NONE, MAX_OPCODES), ErrorCode::Malformed, &["opcodes", "2097152"]);
    assert_refused(b"\x80\x02Nr\xff\xff\xff\xff.", ErrorCode::Malformed, &["memo index 4294967295", "LONG_BINPUT"]);
    assert_refused(b"\x80\x02Nh\x07.", ErrorCode::Malformed, &["memo index 7"]);
    assert_refused(b"\x80\x02X\xff\xff\xff\xffab.", ErrorCode::Malformed, &["found 3 bytes", "expected 4294967295"]);
    assert_refused(b"\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\xffab.", ErrorCode::Malformed, &["BINUNICODE8"]);
    let endless = [b"\x80\x02c".to_vec(), vec![b'a'; 5000]].concat();
    assert_refused(&endless, ErrorCode::Malformed, &["a name without an end"]);
}

#[test]
fn deeply_nested_values_are_built_and_dropped() {
    assert!(load(&[b"\x80\x02)".to_vec(), vec![TUPLE1; 1_000_000], b".".to_vec()].concat()).is_ok());
}

#[test]
fn copies_of_a_long_list_are_counted() {
    // Each REDUCE would copy the list: 1000 pairs, 3000 times.
    let list = [b"](".to_vec(), b"NN\x86".repeat(1000), b"eq\x01".to_vec()].concat();
    let calls = b"ccollections\nOrderedDict\nh\x01\x85R0".repeat(3000);
    assert_refused(&[b"\x80\x02".to_vec(), list, calls, b".".to_vec()].concat(), ErrorCode::Malformed, &["dict items"]);
}

#[test]
fn other_opcodes_and_protocols_are_named() {
    assert_refused(b"\x80\x01N.", ErrorCode::Malformed, &["protocol 1, expected 2 to 5"]);
    assert_refused(b"\x80\x02I1\n.", ErrorCode::Unsupported, &["0x49 (INT)"]);
    assert_refused(b"\x80\x02\xff.", ErrorCode::Malformed, &["0xff (no opcode)"]);
}
