//! The same objects in every protocol of pickle, as Python 3.11 and NumPy 2.4 write them: data, whatever the opcodes.

use reviv::formats::pickle::{Global, Id, Node, Pickle};
use std::path::Path;

/// An object in words. Sets are lists before protocol 4, and bytes are text that is encoded before protocol 3.
fn show(pickle: &Pickle, id: Id) -> String {
    let all = |items: &[Id]| -> String {
        let items: Vec<String> = items.iter().map(|item| show(pickle, *item)).collect();
        items.join(" ")
    };
    match pickle.node(id) {
        Node::None => "none".to_owned(),
        Node::Bool(value) => value.to_string(),
        Node::Int(value) => value.to_string(),
        Node::Float(value) => format!("{value:?}"),
        Node::Complex(real, imaginary) => format!("{real}{imaginary:+}j"),
        Node::Text(text) => format!("{text:?}"),
        Node::Bytes(bytes) => format!("b{bytes:?}"),
        Node::Tuple(items) | Node::List(items) | Node::Set(items) => format!("[{}]", all(items)),
        Node::Dict(_) | Node::Object { .. } => {
            let pairs = pickle.pairs(id).iter();
            let pairs: Vec<String> = pairs
                .map(|(key, value)| format!("{}={}", show(pickle, *key), show(pickle, *value)))
                .collect();
            format!("{{{}}}", pairs.join(" "))
        }
        Node::Array(view) => {
            let array = pickle.array(id).unwrap();
            let values = array.to::<f64>().unwrap();
            format!("{}{:?}{values:?}", view.dtype, array.shape)
                .split(", shape=")
                .next()
                .unwrap()
                .replace([' ', '\n'], "")
        }
        Node::Global(Global::Container) => "container".to_owned(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn every_protocol_describes_the_same_objects() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/pickles");
    let mut first = None;
    for protocol in 0..6 {
        let bytes = std::fs::read(folder.join(format!("protocol{protocol}.pkl"))).unwrap();
        let pickle = Pickle::parse(&bytes).unwrap_or_else(|e| panic!("protocol {protocol}: {e}"));
        let shown = show(&pickle, pickle.root());
        for part in [
            "\"list\"=[1 -2 1099511627776 255 65535 -70000]",
            "\"set\"=[1]",
            "\"text\"=\"h\u{e9}\u{20ac}\u{1f600}\"",
            "\"bytes\"=b[97, 98, 255]",
            "\"more\"=b[113, 0]",
            "\"complex\"=1+2j",
            "\"ordered\"={\"x\"=1 \"y\"=2}",
            "\"default\"={\"k\"=[1]}",
            "\"counter\"={\"a\"=2 \"b\"=1}",
            "\"args\"={\"lr\"=0.5 \"name\"=\"it's\"}",
            "\"array\"=f8[2,3][[0.0,1.0,2.0],[3.0,4.0,5.0]]",
            "\"columns\"=i4[2,3][[1.0,2.0,3.0],[4.0,5.0,6.0]]",
            "\"scalar\"=0.5",
            "\"int\"=-3",
        ] {
            assert!(
                shown.contains(part),
                "protocol {protocol}: no {part} in {shown}"
            );
        }
        assert_eq!(
            first.get_or_insert_with(|| shown.clone()),
            &shown,
            "protocol {protocol}"
        );
    }
}
