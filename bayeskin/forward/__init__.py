"""Forward models behind one protocol: parameters, mechanisms and a protocol in, a force history out."""
