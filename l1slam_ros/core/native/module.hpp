// SPDX-License-Identifier: Apache-2.0
// The module as Python sees it: one submodule for each header. NAME is that of the module.
#include "arrays.hpp"
#include "blocks.hpp"
#include "branch_and_bound.hpp"
#include "cholesky.hpp"
#include "dissection.hpp"
#include "front.hpp"
#include "halpern.hpp"
#include "interior_point.hpp"
#include "likelihood_field.hpp"
#include "noise.hpp"
#include "ordering.hpp"
#include "poses.hpp"
#include "prediction.hpp"
#include "ray_casting.hpp"
#include "scan_matching.hpp"
#include "scan_points.hpp"
#include "se2.hpp"
#include "se3.hpp"
#include "spanning_tree.hpp"
#include "substitution.hpp"
#include "symbolic.hpp"
#include "voxel_grid.hpp"

namespace {

struct Part {
    const char* name;
    PyMethodDef* methods;
    bool (*add_types)(PyObject*) = nullptr;
};
const Part parts[] = {
    {"blocks", blocks::methods},
    {"branch_and_bound", branch_and_bound::methods},
    {"cholesky", cholesky::methods},
    {"dissection", dissection::methods},
    {"front", front::methods, front::add_types},
    {"halpern", halpern::methods},
    {"interior_point", interior_point::methods},
    {"likelihood_field", likelihood_field::methods},
    {"noise", noise::methods},
    {"ordering", ordering::methods},
    {"poses", poses::methods},
    {"prediction", prediction::methods},
    {"ray_casting", ray_casting::methods},
    {"scan_matching", scan_matching::methods},
    {"scan_points", scan_points::methods},
    {"se2", se2::methods},
    {"se3", se3::methods},
    {"spanning_tree", spanning_tree::methods},
    {"substitution", substitution::methods},
    {"symbolic", symbolic::methods},
    {"voxel_grid", voxel_grid::methods},
};
constexpr size_t PARTS = sizeof parts / sizeof *parts;

// Whether this processor runs the code for AVX2 and FMA.
PyObject* has_avx2(PyObject*, PyObject*) {
#if defined(__x86_64__)
    __builtin_cpu_init();
    return PyBool_FromLong(__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"));
#else
    return PyBool_FromLong(0);
#endif
}
PyMethodDef own_methods[] = {{"has_avx2", has_avx2, METH_NOARGS, nullptr}, {}};

PyModuleDef definition_of(const char* name, PyMethodDef* methods) {
    return {PyModuleDef_HEAD_INIT, name,    nullptr, -1, methods,
            nullptr,               nullptr, nullptr, nullptr};
}
#define JOINED(a, b) a##b
#define JOIN(a, b) JOINED(a, b)
#define TEXT(a) #a
#define TEXT_OF(a) TEXT(a)
PyModuleDef definition = definition_of(TEXT_OF(NAME), own_methods);
PyModuleDef definitions[PARTS];

}  // namespace

PyMODINIT_FUNC JOIN(PyInit_, NAME)() {
    import_array();
    PyObject* module = PyModule_Create(&definition);
    for (size_t p = 0; module && p < PARTS; p++) {
        definitions[p] = definition_of(parts[p].name, parts[p].methods);
        PyObject* part = PyModule_Create(&definitions[p]);
        if (!part || (parts[p].add_types && !parts[p].add_types(part)) ||
            PyModule_AddObject(module, parts[p].name, part) < 0) {
            Py_XDECREF(part);
            Py_CLEAR(module);
        }
    }
    return module;
}
