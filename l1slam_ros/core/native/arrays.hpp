// SPDX-License-Identifier: Apache-2.0
// The binding to Python: a C++ function of arrays and numbers is a function of NumPy arrays.
//
// An array must have the exact type and number of dimensions, be C-contiguous and aligned, and be
// writable unless its type is const: otherwise the call raises a TypeError that names the argument.
// Nothing is copied or converted. What a function checks by `require` raises a TypeError, too.
#pragma once
#define PY_SSIZE_T_CLEAN
#ifndef Py_LIMITED_API
#define Py_LIMITED_API 0x030A0000
#endif
#include <Python.h>
#define NPY_NO_DEPRECATED_API NPY_1_23_API_VERSION
#define NPY_TARGET_VERSION NPY_1_23_API_VERSION
#include <numpy/arrayobject.h>

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <memory>
#include <new>
#include <stdexcept>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>

template <class T> struct TypeOf;
#define TYPE_OF(type, number, text) \
    template <> struct TypeOf<type> { \
        static constexpr int NUMBER = number; \
        static constexpr const char* NAME = text; \
    };
TYPE_OF(double, NPY_DOUBLE, "float64")
TYPE_OF(float, NPY_FLOAT, "float32")
TYPE_OF(int8_t, NPY_INT8, "int8")
TYPE_OF(uint8_t, NPY_UINT8, "uint8")
TYPE_OF(int32_t, NPY_INT32, "int32")
TYPE_OF(int64_t, NPY_INT64, "int64")
TYPE_OF(bool, NPY_BOOL, "bool")
#undef TYPE_OF

// Arguments that do not fit together: the caller gets a TypeError with this text.
struct Mismatch : std::runtime_error {
    using std::runtime_error::runtime_error;
};
inline void require(bool holds, const char* expected) {
    if (!holds) throw Mismatch(expected);
}

// A view of an array of N dimensions; T is const where the function only reads.
template <class T, int N> struct Array {
    T* data = nullptr;
    int64_t shape[N] = {};
    PyObject* object = nullptr;

    Array() = default;
    Array(T* data, PyObject* object) : data(data), object(object) {}
    int64_t size() const { return shape[0]; }
    // The entry of a vector, or the address of a row (a block) of what has more dimensions.
    decltype(auto) operator[](int64_t k) const {
        if constexpr (N == 1) return (data[k]);
        else {
            int64_t step = 1;
            for (int n = 1; n < N; n++) step *= shape[n];
            return data + k * step;
        }
    }
    T& operator()(int64_t r, int64_t c) const { return data[r * shape[1] + c]; }
    // Whoever reads takes what may be written, too.
    operator Array<const T, N>() const {
        Array<const T, N> same(data, object);
        for (int n = 0; n < N; n++) same.shape[n] = shape[n];
        return same;
    }
};
template <class T> using Vector = Array<T, 1>;
template <class T> using Matrix = Array<T, 2>;

// An array that Python will own. The interpreter's lock is taken for it: see `Function`.
template <class T, int N> Array<T, N> new_array(const int64_t (&shape)[N]) {
    PyGILState_STATE state = PyGILState_Ensure();
    npy_intp sizes[N];
    Array<T, N> made{};
    for (int n = 0; n < N; n++) sizes[n] = made.shape[n] = shape[n];
    made.object = PyArray_SimpleNew(N, sizes, TypeOf<T>::NUMBER);
    if (made.object)
        made.data = static_cast<T*>(PyArray_DATA(reinterpret_cast<PyArrayObject*>(made.object)));
    else
        PyErr_Clear();
    PyGILState_Release(state);
    if (!made.object) throw std::bad_alloc();
    return made;
}
template <class T> Vector<T> new_vector(int64_t size) { return new_array<T, 1>({size}); }

// `from` fills a C++ value, or writes into `problem` what was expected and returns false.
template <class T> struct Convert;
template <class T, int N> struct Convert<Array<T, N>> {
    using Entry = std::remove_const_t<T>;
    static bool from(PyObject* object, Array<T, N>& view, std::string& problem) {
        auto* array = reinterpret_cast<PyArrayObject*>(object);
        const bool readable = PyArray_Check(object) &&
                              PyArray_TYPE(array) == TypeOf<Entry>::NUMBER &&
                              PyArray_NDIM(array) == N && PyArray_ISCARRAY_RO(array);
        if (!readable || (!std::is_const_v<T> && !PyArray_ISWRITEABLE(array))) {
            problem = std::string("a C-contiguous ") + (std::is_const_v<T> ? "" : "writable ") +
                      TypeOf<Entry>::NAME + " array of " + std::to_string(N) + " dimensions";
            return false;
        }
        view.data = static_cast<T*>(PyArray_DATA(array));
        view.object = object;
        for (int n = 0; n < N; n++) view.shape[n] = PyArray_DIM(array, n);
        return true;
    }
    static PyObject* to(const Array<T, N>& made) { return made.object; }
};
// Rows of doubles that are only read, wherever they lie: of what Python has cut or repeated.
struct Rows {
    const char* data = nullptr;
    int64_t shape[2] = {}, step[2] = {};  // step : in bytes
};
template <> struct Convert<Rows> {
    static bool from(PyObject* object, Rows& rows, std::string& problem) {
        auto* array = reinterpret_cast<PyArrayObject*>(object);
        if (!PyArray_Check(object) || PyArray_TYPE(array) != NPY_DOUBLE ||
            PyArray_NDIM(array) != 2 || !PyArray_ISBEHAVED_RO(array)) {
            problem = "a float64 array of 2 dimensions";
            return false;
        }
        rows.data = static_cast<const char*>(PyArray_DATA(array));
        for (int n = 0; n < 2; n++)
            rows.shape[n] = PyArray_DIM(array, n), rows.step[n] = PyArray_STRIDE(array, n);
        return true;
    }
};
template <> struct Convert<double> {
    static bool from(PyObject* object, double& value, std::string& problem) {
        value = PyFloat_AsDouble(object);
        if (value != -1.0 || !PyErr_Occurred()) return true;
        PyErr_Clear();
        problem = "a number";
        return false;
    }
    static PyObject* to(double value) { return PyFloat_FromDouble(value); }
};
template <> struct Convert<int64_t> {
    static bool from(PyObject* object, int64_t& value, std::string& problem) {
        value = PyLong_AsLongLong(object);
        if (value != -1 || !PyErr_Occurred()) return true;
        PyErr_Clear();
        problem = "a whole number of 64 bits";
        return false;
    }
    static PyObject* to(int64_t value) { return PyLong_FromLongLong(value); }
};
template <> struct Convert<bool> {
    static bool from(PyObject* object, bool& value, std::string& problem) {
        int truth = PyObject_IsTrue(object);
        if (truth < 0) PyErr_Clear(), problem = "True or False";
        value = truth > 0;
        return truth >= 0;
    }
    static PyObject* to(bool value) { return PyBool_FromLong(value); }
};
template <class... Ts> struct Convert<std::tuple<Ts...>> {
    static PyObject* to(const std::tuple<Ts...>& parts) {
        PyObject* whole = PyTuple_New(sizeof...(Ts));
        if (whole) set(whole, parts, std::index_sequence_for<Ts...>{});
        return whole;
    }
    template <size_t... I>
    static void set(PyObject* whole, const std::tuple<Ts...>& parts, std::index_sequence<I...>) {
        (PyTuple_SetItem(whole, I, Convert<Ts>::to(std::get<I>(parts))), ...);
    }
};

// An object of C++ that Python holds: a type of its own, made by `add_type`, without a constructor.
// Functions take it as a pointer, their first argument; they are its methods.
template <class T> struct Held {
    PyObject_HEAD
    T* object;
    inline static PyTypeObject* type = nullptr;

    static void end(PyObject* self) {
        PyTypeObject* own = Py_TYPE(self);
        delete reinterpret_cast<Held*>(self)->object;
        PyObject_Free(self);
        Py_DECREF(own);
    }
};
template <class T> struct Convert<T*> {
    static bool from(PyObject* object, T*& value, std::string& problem) {
        if (!PyObject_TypeCheck(object, Held<T>::type)) {
            problem = "a " + std::string(T::NAME);
            return false;
        }
        value = reinterpret_cast<Held<T>*>(object)->object;
        return true;
    }
};
template <class T> struct Convert<std::unique_ptr<T>> {
    static PyObject* to(std::unique_ptr<T>& made) {
        auto* held = PyObject_New(Held<T>, Held<T>::type);
        if (held) held->object = made.release();
        return reinterpret_cast<PyObject*>(held);
    }
};

// The name of argument k in a signature "function(first, second)\n--\n\n".
inline std::string argument_name(const char* signature, size_t k) {
    const char* at = std::strchr(signature, '(') + 1;
    for (; k; k--) at = std::strchr(at, ',') + 2;
    return {at, std::strcspn(at, ",)")};
}

// What a caller handed in, for an error.
inline PyObject* description(PyObject* object) {
    if (!PyArray_Check(object))
        return PyUnicode_FromFormat("%R", reinterpret_cast<PyObject*>(Py_TYPE(object)));
    auto* array = reinterpret_cast<PyArrayObject*>(object);
    PyObject* type = PyObject_GetAttrString(object, "dtype");
    PyObject* shape = PyObject_GetAttrString(object, "shape");
    PyObject* text = nullptr;
    if (type && shape)
        text = PyUnicode_FromFormat("a%s%s %S array of shape %S",
                                    PyArray_ISWRITEABLE(array) ? "" : " read-only",
                                    PyArray_IS_C_CONTIGUOUS(array) ? "" : " strided", type, shape);
    Py_XDECREF(type);
    Py_XDECREF(shape);
    return text;
}

// How many numbers an argument holds, if it is an array.
template <class T> int64_t entries(const T&) { return 0; }
template <class T, int N> int64_t entries(const Array<T, N>& array) {
    int64_t count = 1;
    for (int n = 0; n < N; n++) count *= array.shape[n];
    return count;
}

// While it lives the interpreter's lock is let go, unless `held`.
struct Unlocked {
    PyThreadState* state;
    explicit Unlocked(bool held) : state(held ? nullptr : PyEval_SaveThread()) {}
    Unlocked(const Unlocked&) = delete;
    ~Unlocked() {
        if (state) PyEval_RestoreThread(state);
    }
};

// What Python calls for F. The interpreter's lock is let go unless the function is BRIEF, or its
// arrays hold FEW numbers or less: whoever lets go of it may have to wait until another thread lets
// go of it in turn.
template <auto F, bool BRIEF, int64_t FEW = -1> struct Function;
template <class R, class... Ts, R (*F)(Ts...), bool BRIEF, int64_t FEW>
struct Function<F, BRIEF, FEW> {
    inline static const char* signature = "";

    static PyObject* call(PyObject*, PyObject* const* given, Py_ssize_t count) {
        if (count != static_cast<Py_ssize_t>(sizeof...(Ts)))
            return PyErr_Format(PyExc_TypeError, "%s takes %zu arguments, not %zd", name().c_str(),
                                sizeof...(Ts), count);
        return run(given, std::index_sequence_for<Ts...>{});
    }

  private:
    static std::string name() { return {signature, std::strcspn(signature, "(")}; }
    static bool fail(size_t k, PyObject* object, const std::string& expected) {
        if (PyObject* found = description(object)) {
            PyErr_Format(PyExc_TypeError, "%s: %s must be %s, found %U", name().c_str(),
                         argument_name(signature, k).c_str(), expected.c_str(), found);
            Py_DECREF(found);
        }
        return false;
    }
    template <size_t I, class T> static bool convert(PyObject* const* given, T& value) {
        std::string expected;
        return Convert<T>::from(given[I], value, expected) || fail(I, given[I], expected);
    }
    template <size_t... I>
    static PyObject* run(PyObject* const* given, std::index_sequence<I...>) {
        std::tuple<Ts...> values{};
        if (!(convert<I>(given, std::get<I>(values)) && ...)) return nullptr;
        const bool is_brief = BRIEF || (entries(std::get<I>(values)) + ... + 0) <= FEW;
        auto called = [&] {
            const Unlocked unlocked(is_brief);
            return F(std::get<I>(values)...);
        };
        try {
            if constexpr (std::is_void_v<R>) {
                called();
                Py_INCREF(Py_None);
                return Py_None;
            } else {
                R result = called();
                return Convert<R>::to(result);
            }
        } catch (const Mismatch& problem) {
            return PyErr_Format(PyExc_TypeError, "%s: %s", name().c_str(), problem.what());
        } catch (const std::bad_alloc&) {
            return PyErr_NoMemory();
        } catch (const std::length_error&) {  // a vector of more than there can be
            return PyErr_NoMemory();
        } catch (const std::exception& problem) {  // such as a thread that cannot be started
            return PyErr_Format(PyExc_RuntimeError, "%s: %s", name().c_str(), problem.what());
        }
    }
};

template <auto F, bool BRIEF, int64_t FEW = -1>
PyMethodDef method(const char* name, const char* signature) {
    Function<F, BRIEF, FEW>::signature = signature;
    return {name,
            reinterpret_cast<PyCFunction>(
                reinterpret_cast<void (*)()>(&Function<F, BRIEF, FEW>::call)),
            METH_FASTCALL, signature};
}
// The same for the method of a type: what it is called on is the first argument.
template <auto F> struct Method;
template <class R, class... Ts, R (*F)(Ts...)> struct Method<F> {
    static PyObject* call(PyObject* self, PyObject* const* given, Py_ssize_t count) {
        PyObject* all[sizeof...(Ts)] = {self};
        if (count == static_cast<Py_ssize_t>(sizeof...(Ts)) - 1)
            std::copy(given, given + count, all + 1);
        return Function<F, true>::call(nullptr, all, count + 1);
    }
};
template <auto F> PyMethodDef method_of_type(const char* name, const char* signature) {
    Function<F, true>::signature = signature;
    return {name,
            reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(&Method<F>::call)),
            METH_FASTCALL, signature};
}
// Adds the type of T to a module; its methods keep the interpreter's lock, so no two run at once.
template <class T> bool add_type(PyObject* module, PyMethodDef* methods) {
    PyType_Slot slots[] = {{Py_tp_dealloc, reinterpret_cast<void*>(&Held<T>::end)},
                           {Py_tp_methods, methods},
                           {0, nullptr}};
    PyType_Spec spec{T::NAME, sizeof(Held<T>), 0,
                     Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION, slots};
    PyObject* type = PyType_FromSpec(&spec);
    Held<T>::type = reinterpret_cast<PyTypeObject*>(type);
    const char* name = std::strrchr(T::NAME, '.');
    Py_XINCREF(type);
    return type && PyModule_AddObject(module, name ? name + 1 : T::NAME, type) == 0;
}

// Entries of a table of methods: a function of this namespace and the names of its arguments.
// BRIEF keeps the interpreter's lock: for what takes less than 20 us.
#define FUNCTION(function, arguments) \
    method<&function, false>(#function, #function "(" arguments ")\n--\n\n")
#define BRIEF(function, arguments) \
    method<&function, true>(#function, #function "(" arguments ")\n--\n\n")
// BY_SIZE does so where all arrays together are that small: for a few nanoseconds a number.
#define BY_SIZE(function, arguments) \
    method<&function, false, 5000>(#function, #function "(" arguments ")\n--\n\n")
#define METHOD(function, arguments) \
    method_of_type<&function>(#function, #function "(" arguments ")\n--\n\n")
